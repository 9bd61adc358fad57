"""Images of the fisheye camera: rendering, rectified views, overlays."""
