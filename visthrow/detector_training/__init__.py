"""Train the keypoint detector on rendered pictures.

This room is optional: nothing outside it imports it. `camera.detectors.learnt` is the trained
detector for flight."""
