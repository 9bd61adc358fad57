"""Fisheye camera of the vision policy. Knows neither the simulator nor the rest of the project.

`camera.params` configures it; `fisheye` is the lens, `mount` its place on the vehicle, `keypoints`
what the policy sees, `history` and `noise` what age and imperfection make of that (torch).
`overlay` draws on frames (cv2) and `rectify` straightens them (kornia). `camera.calibrate` reads
and makes calibrations, `camera.detectors` finds ball and goal square on frames,
`visthrow.detector_training.scenes` renders those that detectors are trained on (Warp).

Frames: ``_w`` world (z up), ``_b`` body (x forward, y left, z up), ``_c`` camera (x image right, y
image down, z along the optical axis)."""
