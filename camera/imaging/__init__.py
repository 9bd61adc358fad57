"""Images of the fisheye camera: rectified views, overlays."""
