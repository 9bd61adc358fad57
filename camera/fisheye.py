"""Kannala-Brandt fisheye model on tensors and arrays, valid beyond 90 deg off the axis, finite and
differentiable on the whole sphere.

The functions run on a batch of thousands inside a CUDA graph and on a single row on board: they
make no host copies, do not branch on data and do not index by boolean masks. They use only
elementwise operations whose vectorised and scalar code round identically (``atan``, but not
``atan2``), so that a batch of N equals N single calls bit for bit on the CPU."""

from typing import Any

import torch

from camera.arrays import Array, library
from camera.params import FisheyeParams

AXIS_EPSILON = 1e-20
"""Added to x^2 + y^2 so that value and gradient are finite on the axis: a radius of 1e-10 in the
points' unit.
"""

NEWTON_STEPS = 16
"""Safeguarded Newton steps of the inverse, with bisection if a step would leave the bracket."""


class Fisheye:
    """Projection and unprojection of a Kannala-Brandt fisheye.

    Normalised image coordinates are 1 at the edge of the stated field of view, in every direction
    and for any fx, fy: ``x_n = (u - cx) / (fx R)``, ``y_n = (v - cy) / (fy R)`` with ``R =
    theta_d(fov / 2)``. They do not depend on fx, fy, cx, cy at all, only on the shape of theta_d
    and the field of view.

    Beyond the field of view theta_d continues along its tangent, so that the map is one-to-one and
    smooth on the whole sphere even if the polynomial folds back. Such points are never valid.
    Results have the dtype and device of the input.

    Attributes:
        params: The intrinsics.
        half_fov: Largest valid angle off the axis [rad].
        edge_radius: ``R = theta_d(fov / 2)`` [rad].
        circle_inside_image: Whether the whole field of view is on the sensor. If not, a valid point
            must also be on the sensor.
    """

    def __init__(self, params: FisheyeParams):
        """Precompute the constants of projection and its inverse."""
        self.params = params
        self.half_fov = params.half_fov
        self._equidistant = not any(params.coefficients)
        edge = torch.tensor(self.half_fov, dtype=torch.float64)
        self._edge_slope = self.slope_from_angle(edge).item()
        self.edge_radius = self.radius_from_angle(edge).item()
        reach_x = params.fx * self.edge_radius
        reach_y = params.fy * self.edge_radius
        slack = 1e-9
        low = -0.5 - slack
        right = params.width - 0.5 + slack
        bottom = params.height - 0.5 + slack
        self._bounds = (low, right, low, bottom)
        fits_x = params.cx - reach_x >= low and params.cx + reach_x <= right
        fits_y = params.cy - reach_y >= low and params.cy + reach_y <= bottom
        self.circle_inside_image = fits_x and fits_y
        self._constants: dict[tuple[Any, Any], tuple[Any, Any]] = {}

    def angle(self, points_c: Array, epsilon: float = AXIS_EPSILON) -> tuple[Array, Array, Array]:
        """Return the angles of points off the optical axis.

        Args:
            points_c: Points [any unit], shape (..., 3), camera frame.
            epsilon: Added to x^2 + y^2 [unit of the points, squared].

        Returns:
            theta in [0, pi] [rad], distance from the axis and distance from the lens [unit of the
            points], each shape (...).
        """
        xp = library(points_c)
        x, y, z = points_c[..., 0], points_c[..., 1], points_c[..., 2]
        radius2 = x * x + y * y + epsilon
        radius = xp.sqrt(radius2)
        distance = xp.sqrt(radius2 + z * z)
        backward = z < 0.0
        # theta / 2 = atan(r / (d + z)) = atan((d - z) / r): each side of the lens plane uses the
        # form without cancellation.
        reach = distance + abs(z)
        tangent = xp.where(backward, reach, radius) / xp.where(backward, radius, reach)
        return xp.atan(tangent) * 2.0, radius, distance

    def radius_from_angle(self, theta: Array) -> Array:
        """Return theta_d [rad], shape of theta; beyond the field of view it follows its tangent."""
        if self._equidistant:
            return theta
        k1, k2, k3, k4 = self.params.coefficients
        inner = theta.clip(max=self.half_fov)
        t2 = inner * inner
        radius = inner * (t2 * (t2 * (t2 * (t2 * k4 + k3) + k2) + k1) + 1.0)
        return radius + (theta - inner) * self._edge_slope

    def slope_from_angle(self, theta: Array) -> Array:
        """Return d theta_d / d theta [-], shape of theta; constant beyond the field of view."""
        if self._equidistant:
            return library(theta).ones_like(theta)
        k1, k2, k3, k4 = self.params.coefficients
        inner = theta.clip(max=self.half_fov)
        t2 = inner * inner
        return t2 * (t2 * (t2 * (t2 * (9 * k4) + 7 * k3) + 5 * k2) + 3 * k1) + 1.0

    def project_normalized(self, points_c: Array, clip: bool = False) -> tuple[Array, Array]:
        """Project points to normalised image coordinates.

        Args:
            points_c: Points [any unit], shape (..., 3), camera frame.
            clip: Move points outside the field of view to its edge (radius 1) along their direction
                in the image.

        Returns:
            Normalised coordinates [-], shape (..., 2), and validity (bool), shape (...): inside the
            field of view and on the sensor.
        """
        theta, radius, _ = self.angle(points_c)
        valid = theta <= self.half_fov
        shrink = self.radius_from_angle(theta.clip(max=self.half_fov) if clip else theta) / radius
        normalized = points_c[..., :2] * (shrink * (1.0 / self.edge_radius))[..., None]
        if not self.circle_inside_image:
            valid = valid & self.is_on_sensor(self.denormalize(normalized))
        return normalized, valid

    def project(self, points_c: Array) -> tuple[Array, Array]:
        """Project points to pixels.

        Args:
            points_c: Points [any unit], shape (..., 3), camera frame.

        Returns:
            Pixels [px], shape (..., 2), finite everywhere, and validity (bool), shape (...): theta
            <= fov / 2. `is_on_sensor` tests whether a valid point is also on the sensor.
        """
        theta, radius, _ = self.angle(points_c)
        focal, centre = self._pixel_constants(points_c)
        scale = (self.radius_from_angle(theta) / radius)[..., None]
        return points_c[..., :2] * scale * focal + centre, theta <= self.half_fov

    def unproject(self, pixels: Array) -> tuple[Array, Array]:
        """Turn pixels into unit rays.

        Args:
            pixels: Pixels [px], shape (..., 2).

        Returns:
            Unit rays [-], shape (..., 3), camera frame, and validity (bool), shape (...): inside
            the field of view. A pixel beyond the field of view gives the ray at its edge.
        """
        xp = library(pixels)
        focal, centre = self._pixel_constants(pixels)
        plane = (pixels - centre) / focal
        x, y = plane[..., 0], plane[..., 1]
        radius = xp.sqrt(x * x + y * y + AXIS_EPSILON)
        # the projection of a ray at the edge may round to either side of it
        valid = radius <= self.edge_radius * (1.0 + 8.0 * float(xp.finfo(pixels.dtype).eps))
        theta = self._angle_from_radius(radius.clip(max=self.edge_radius))
        lateral = plane * (xp.sin(theta) / radius)[..., None]
        return xp.concatenate([lateral, xp.cos(theta)[..., None]], -1), valid

    def normalize(self, pixels: Array) -> Array:
        """Convert pixels [px] to normalised image coordinates [-], both shape (..., 2)."""
        focal, centre = self._pixel_constants(pixels)
        return (pixels - centre) / (focal * self.edge_radius)

    def denormalize(self, normalized: Array) -> Array:
        """Convert normalised image coordinates [-] to pixels [px], both shape (..., 2)."""
        focal, centre = self._pixel_constants(normalized)
        return normalized * (focal * self.edge_radius) + centre

    def is_on_sensor(self, pixels: Array) -> Array:
        """Return whether pixels [px], shape (..., 2), are on the sensor including the outer pixels'
        edges: bool, shape (...).
        """
        low, right, top, bottom = self._bounds
        u, v = pixels[..., 0], pixels[..., 1]
        return (u >= low) & (u <= right) & (v >= top) & (v <= bottom)

    def _angle_from_radius(self, radius: Array) -> Array:
        """Invert theta_d by Newton's method inside a shrinking bracket; differentiable through the
        last step.
        """
        if self._equidistant:
            return radius
        xp = library(radius)
        with torch.no_grad():
            theta = radius * (self.half_fov / self.edge_radius)
            low = xp.zeros_like(theta)
            high = xp.full_like(theta, self.half_fov)
            for _ in range(NEWTON_STEPS):
                excess = self.radius_from_angle(theta) - radius
                low = xp.where(excess < 0.0, theta, low)
                high = xp.where(excess < 0.0, high, theta)
                step = theta - excess / self.slope_from_angle(theta)
                theta = xp.where((step < low) | (step > high), (low + high) * 0.5, step)
        return theta - (self.radius_from_angle(theta) - radius) / self.slope_from_angle(theta)

    def _pixel_constants(self, like: Array) -> tuple[Array, Array]:
        """Return focal lengths and principal point on a tensor's device. They are cached, because
        they cannot be created while a CUDA graph is captured.
        """
        key = (like.device, like.dtype)
        if key not in self._constants:
            p = self.params
            pairs = ([p.fx, p.fy], [p.cx, p.cy])
            make = {"device": like.device, "dtype": like.dtype}
            focal, centre = (library(like).asarray(pair, **make) for pair in pairs)
            self._constants[key] = focal, centre
        return self._constants[key]
