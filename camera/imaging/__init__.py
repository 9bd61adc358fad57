"""Images of the fisheye camera: rendering, rectified views, nuisances, overlays."""
