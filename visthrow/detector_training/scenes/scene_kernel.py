"""The renderer's kernel, with one thread for each pixel: it intersects rays through the lens with
ball, other objects, rope, goal square, ground and walls.

Each sample of a pixel has its own position in the pixel, blurred by the defocus, and its own time
within the exposure of its row. Motion blur, rolling shutter and defocus follow from this. Colours
are linear up to the sensor, which adds shot noise, read noise and gamma. The structs hold the rows
of `scene.Scenes`; `rows.toml` describes their columns. The same seed yields the same picture."""

from typing import Any

import warp as wp

from visthrow.detector_training.scenes import textures
from visthrow.detector_training.scenes.scene import ROW_COLUMNS

LENS_STEPS = wp.constant(12)  # Newton iterations for the angle of a pixel; the lens is monotonic

VEHICLE_RADIUS = wp.constant(0.09)  # radius of the vehicle's shadow [m]
MIPS = wp.constant(textures.MIPS)
SIZE = wp.constant(textures.SIZE)


def _struct(name: str, columns: dict[str, Any]) -> Any:
    """Return the Warp struct of a row."""
    fields = {"__module__": __name__, "__annotations__": columns}
    return wp.struct(type(f"{name.title()}Row", (), fields))


_ROWS = {
    name: _struct(name, {column: getattr(wp, kind) for column, kind in columns.items()})
    for name, columns in ROW_COLUMNS.items()
}
GoalRow = _ROWS["goal"]
LightRow = _ROWS["light"]
RopeRow = _ROWS["rope"]
ThingRow = _ROWS.pop("thing")
SceneRow = _struct("scene", _ROWS)  # without its things

Things = wp.array2d(dtype=ThingRow)
Textures = wp.array2d(dtype=wp.uint8)


@wp.func
def theta_d(theta: float, k: wp.vec4) -> float:
    """Return the normalised distance from the principal point for an angle from the axis [rad]."""
    t2 = theta * theta
    return theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))


@wp.func
def turn_axes(x: float, y: float, yaw: float) -> wp.vec2:
    """Return the coordinates of a point on axes that are rotated by an angle."""
    c = wp.cos(yaw)
    s = wp.sin(yaw)
    return wp.vec2(c * x + s * y, c * y - s * x)


@wp.func
def angle_of(radius: float, k: wp.vec4, limit: float) -> float:
    """Return the angle from the axis [rad] for a normalised distance from the principal point."""
    theta = wp.min(radius, limit)
    for _ in range(LENS_STEPS):
        t2 = theta * theta
        slope = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])))
        theta = wp.clamp(theta - (theta_d(theta, k) - radius) / wp.max(slope, 0.05), 0.0, limit)
    return theta


@wp.func
def mirror(x: float) -> float:
    """Return a coordinate folded into 0 to 1, as photographs tile without seams only if
    mirrored.
    """
    y = x - 2.0 * wp.floor(0.5 * x)
    return wp.where(y > 1.0, 2.0 - y, y)


@wp.func
def texel(textures: Textures, which: int, base: int, size: int, x: int, y: int) -> wp.vec3:
    address = base + (wp.min(y, size - 1) * size + wp.min(x, size - 1)) * 3
    return (
        wp.vec3(
            float(textures[which, address]),
            float(textures[which, address + 1]),
            float(textures[which, address + 2]),
        )
        / 255.0
    )


@wp.func
def texture(
    textures: Textures,
    which: int,
    u: float,
    v: float,
    footprint: float,
    chance: float,
) -> wp.vec3:
    """Return the bilinear colour of a texture at u, v [tiles]; ``footprint``: size of the sample
    [tiles], ``chance``: random number that rounds the level.
    """
    if which < 0:  # plain grey
        return wp.vec3(1.0, 1.0, 1.0)
    level = int(
        wp.clamp(wp.log2(wp.max(footprint * float(SIZE), 1.0)) + chance, 0.0, float(MIPS - 1))
    )
    base = int(0)
    size = int(SIZE)
    for _ in range(level):
        base += size * size * 3
        size = size / 2
    x = mirror(u) * float(size - 1)
    y = mirror(v) * float(size - 1)
    i = int(x)
    j = int(y)
    a = x - float(i)
    b = y - float(j)
    first = wp.lerp(
        texel(textures, which, base, size, i, j), texel(textures, which, base, size, i, j + 1), b
    )
    second = wp.lerp(
        texel(textures, which, base, size, i + 1, j),
        texel(textures, which, base, size, i + 1, j + 1),
        b,
    )
    return wp.lerp(first, second, a)


@wp.func
def sphere(eye: wp.vec3, ray: wp.vec3, centre: wp.vec3, radius: float) -> float:
    """Return the distance to a ball along a ray, or a large number."""
    offset = centre - eye
    distance = wp.dot(ray, offset)
    discriminant = radius * radius - wp.dot(offset, offset) + distance * distance
    hit = discriminant > 0.0 and distance > 0.0
    return wp.where(hit, distance - wp.sqrt(wp.max(discriminant, 0.0)), 1.0e9)


@wp.func
def lit(normal: wp.vec3, light: LightRow) -> float:
    return light.ambient + (1.0 - light.ambient) * wp.max(wp.dot(normal, light.dir), 0.0)


@wp.func
def ball_colour(normal: wp.vec3, turn: wp.quat, colour: wp.vec3, seam: wp.vec3) -> wp.vec3:
    """Return the colour of a tennis ball, felt or seam, for a normal."""
    n = wp.quat_rotate_inv(turn, normal)
    off = wp.abs(n[2] - 0.45 * wp.sin(2.0 * wp.atan2(n[1], n[0])))
    return wp.where(off < 0.09, seam, colour)


@wp.func
def square(x: float, y: float, goal: GoalRow, below: wp.vec3) -> wp.vec3:
    """Return the goal square's colour at a point relative to its centre, on its axes [m], or
    ``below`` outside it.
    """
    reach = wp.max(wp.abs(x), wp.abs(y))
    side = goal.side
    mark = int(goal.mark)
    half = 0.5 * side
    inner = half - goal.rim
    colour = wp.where(reach < half, goal.edge, below)
    colour = wp.where(reach < inner, goal.field, colour)
    marked = bool(False)
    if mark == 1:
        marked = wp.min(wp.abs(x), wp.abs(y)) < 0.06 * side
    if mark == 2:
        marked = x * x + y * y < 0.04 * side * side
    if mark == 3:
        marked = wp.abs(x) + wp.abs(y) < 0.3 * side and wp.abs(x) + wp.abs(y) > 0.2 * side
    return wp.where(marked and reach < inner, goal.dark, colour)


@wp.func
def thing_over(thing: ThingRow, point: wp.vec3, below: wp.vec3) -> wp.vec3:
    """Return the colour of a disc or rectangle at a point of the ground, or ``below`` outside
    it.
    """
    kind = int(thing.kind)
    if kind != 1 and kind != 2:
        return below
    place = turn_axes(point[0] - thing.place[0], point[1] - thing.place[1], thing.yaw)
    lateral = place[0] / thing.size[0]
    axial = place[1] / thing.size[1]
    reach = wp.max(wp.abs(lateral), wp.abs(axial))
    covered = wp.where(kind == 1, lateral * lateral + axial * axial < 1.0, reach < 1.0)
    rim = wp.vec3(thing.rim, thing.rim, thing.rim)
    colour = wp.where(reach > thing.rim_from, rim, thing.colour)
    return wp.where(covered, colour, below)


@wp.func
def shade(colour: wp.vec3, point: wp.vec3, body: wp.vec3, size: float, light: LightRow) -> wp.vec3:
    """Return a colour of the ground, darkened by the soft shadow of a round body."""
    x = point[0] - body[0] + light.dir[0] / light.dir[2] * body[2]
    y = point[1] - body[1] + light.dir[1] / light.dir[2] * body[2]
    soft = size + 0.15 * body[2]
    strength = light.depth * size / soft
    return colour * (1.0 - strength * wp.exp(-(x * x + y * y) / (soft * soft)))


@wp.func
def ground_colour(
    scene: SceneRow,
    things: Things,
    textures: Textures,
    e: int,
    eye: wp.vec3,
    ray: wp.vec3,
    depth: float,
    chance: float,
) -> wp.vec3:
    """Return the colour of the ground with texture, objects, goal square, and the shadows of ball
    and vehicle.
    """
    ground = scene.ground
    point = eye + ray * depth
    tile = turn_axes(point[0], point[1], ground.yaw) / ground.tile + ground.offset
    pixel = 1.0 / scene.lens.focus[0]
    footprint = depth * pixel / (wp.max(-ray[2], 0.03) * ground.tile)
    colour = texture(textures, int(ground.texture), tile[0], tile[1], footprint, chance)
    colour = wp.cw_mul(colour, ground.tint)
    for i in range(things.shape[1]):
        colour = thing_over(things[e, i], point, colour)
    goal = scene.goal
    place = turn_axes(point[0] - goal.place[0], point[1] - goal.place[1], goal.yaw)
    colour = square(place[0], place[1], goal, colour)
    colour = shade(colour, point, scene.ball.centre, scene.ball.radius, scene.light)
    colour = shade(colour, point, eye, VEHICLE_RADIUS, scene.light)
    return colour * lit(wp.vec3(0.0, 0.0, 1.0), scene.light)


@wp.func
def wall_distance(half: float, eye: float, ray: float) -> float:
    """Return the distance along a ray to one of two opposite walls, from components on one axis."""
    wall = wp.where(ray > 0.0, half, -half)
    return (wall - eye) / wp.where(wp.abs(ray) < 1.0e-6, 1.0e-6, ray)


@wp.func
def wall_colour(
    scene: SceneRow, textures: Textures, eye: wp.vec3, ray: wp.vec3, chance: float
) -> wp.vec3:
    """Return the colour of walls and ceiling, a box with a photograph on each side."""
    walls = scene.walls
    tx = wall_distance(walls.half, eye[0], ray[0])
    ty = wall_distance(walls.half, eye[1], ray[1])
    tz = wp.where(ray[2] > 1.0e-4, (walls.height - eye[2]) / wp.max(ray[2], 1.0e-4), 1.0e9)
    depth = wp.min(wp.min(tx, ty), tz)
    point = eye + ray * depth
    u = wp.where(depth == tx, point[1], point[0])
    v = wp.where(depth == tz, point[1], point[2])
    pixel = 1.0 / scene.lens.focus[0]
    footprint = depth * pixel / walls.tile
    colour = texture(
        textures, int(walls.texture), u / walls.tile, v / walls.tile, footprint, chance
    )
    return colour * walls.brightness


@wp.func
def hides(rope: RopeRow, eye: wp.vec3, ray: wp.vec3, centre: wp.vec3, depth: float) -> bool:
    """Return whether the rope to a ball hides the point at a depth along a ray."""
    top = rope.top + eye
    off = top - eye
    way = centre - top
    sideways = wp.cross(ray, way)
    gap = wp.abs(wp.dot(off, sideways)) / wp.max(wp.length(sideways), 1.0e-9)
    a = wp.dot(way, way)
    b = wp.dot(ray, way)
    share = (b * wp.dot(off, ray) - wp.dot(off, way)) / wp.max(a - b * b, 1.0e-9)
    reach = wp.dot(ray, off + way * share)
    return gap < rope.radius and share > 0.0 and share < 1.0 and reach > 0.0 and reach < depth


@wp.func
def radiance(
    scene: SceneRow,
    things: Things,
    textures: Textures,
    e: int,
    eye: wp.vec3,
    ray: wp.vec3,
    centre: wp.vec3,
    chance: float,
) -> wp.vec3:
    """Return the light along a ray from the nearest of rope, ball, other balls, ground and
    walls.
    """
    light = scene.light
    ball = scene.ball
    if ray[2] < -1.0e-4:
        depth = -eye[2] / ray[2]
        colour = ground_colour(scene, things, textures, e, eye, ray, depth, chance)
    else:
        depth = 1.0e8
        colour = wall_colour(scene, textures, eye, ray, chance)
    for i in range(things.shape[1]):
        thing = things[e, i]
        if int(thing.kind) == 3:
            sphere_depth = sphere(eye, ray, thing.place, thing.size[0])
            if sphere_depth < depth:
                depth = sphere_depth
                normal = (eye + ray * sphere_depth - thing.place) / thing.size[0]
                colour = thing.colour * lit(normal, light)
    sphere_depth = sphere(eye, ray, centre, ball.radius)
    if sphere_depth < depth:
        depth = sphere_depth
        normal = (eye + ray * sphere_depth - centre) / ball.radius
        colour = ball_colour(normal, ball.turn, ball.colour, ball.seam) * lit(normal, light)
    if hides(scene.rope, eye, ray, centre, depth):
        colour = scene.rope.colour
    return wp.cw_mul(colour, light.colour)


@wp.kernel
def render(
    # In:
    seed: int,
    samples: int,
    scenes: wp.array(dtype=SceneRow),
    things: Things,
    textures: Textures,
    # Out:
    image: wp.array4d(dtype=wp.uint8),
):
    """Render a pixel."""
    e, v, u = wp.tid()
    scene = scenes[e]
    lens = scene.lens
    pose = scene.pose
    ball = scene.ball
    shutter = scene.shutter
    sensor = scene.sensor
    height = float(image.shape[1])
    chance = wp.rand_init(seed + int(sensor.seed), (v * image.shape[2] + u))
    k = lens.k
    edge = theta_d(lens.limit, k)
    row = ((float(v) + 0.5) / height - 0.5) * shutter.readout
    total = wp.vec3()
    for i in range(samples):
        time = row + shutter.exposure * ((float(i) + wp.randf(chance)) / float(samples) - 0.5)
        x = float(u) + wp.randf(chance) - 0.5 + shutter.defocus * wp.randn(chance) - lens.centre[0]
        y = float(v) + wp.randf(chance) - 0.5 + shutter.defocus * wp.randn(chance) - lens.centre[1]
        x = x / lens.focus[0]
        y = y / lens.focus[1]
        radius = wp.sqrt(x * x + y * y)
        level = wp.randf(chance)
        if radius <= edge:
            theta = angle_of(radius, k, lens.limit)
            scale = wp.where(radius > 1.0e-6, wp.sin(theta) / wp.max(radius, 1.0e-6), 1.0)
            ray_c = wp.vec3(x * scale, y * scale, wp.cos(theta))
            axis = wp.normalize(pose.rate + wp.vec3(1.0e-9, 0.0, 0.0))
            turned = pose.quat * wp.quat_from_axis_angle(axis, wp.length(pose.rate) * time)
            ray = wp.quat_rotate(turned, ray_c)
            eye = pose.eye + pose.vel * time
            centre = ball.centre + ball.vel * time
            incoming = radiance(scene, things, textures, e, eye, ray, centre, level)
            total += incoming * wp.pow(wp.max(wp.cos(0.5 * theta), 0.0), lens.vignetting)
    colour = total * (sensor.gain / float(samples))
    for c in range(3):
        value = colour[c]
        value += wp.sqrt(wp.max(value, 0.0)) * sensor.shot * wp.randn(chance)
        value += sensor.read * wp.randn(chance)
        value = wp.pow(wp.clamp(value, 0.0, 1.0), sensor.gamma)
        image[e, v, u, c] = wp.uint8(value * 255.0 + 0.5)
