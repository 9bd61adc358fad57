"""Fisheye camera of the vision policy, independent of the simulator and the rest of the project.

`camera.params` holds its configuration, `fisheye` the lens model, `mount` the extrinsics,
`keypoints` the policy's image measurements, `keypoint_noise` their noise and latency (torch).
`overlay` draws on frames (cv2) and `rectify` cuts pinhole views out of them (kornia).
`camera.calibrate` reads calibration files and calibrates from pictures; `camera.detectors` detects
ball and goal square on frames. `visthrow.detector_training.scenes` renders training frames (Warp).

Frames: ``_w`` world (z up), ``_b`` body (x forward, y left, z up), ``_c`` camera (x image right, y
image down, z along the optical axis)."""
