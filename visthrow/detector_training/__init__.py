"""The training of the keypoint detector, and the renderer of the pictures that it learns from.

An optional room: nothing outside it imports it. The trained detector that flies is
`camera.detectors.learnt`."""
