"""The renderer's kernel: one thread a pixel, rays through the lens against ball, things, rope,
ground square, ground and walls.

Each sample of a pixel has its own place in it, spread by the defocus, and its own instant within
the exposure of its row, so that motion, rolling shutter and defocus need no code of their own.
Colours are linear up to the sensor, which adds shot and read noise and the gamma. Rows of the
arrays are described in `scene.Scenes` beside this file. The same seed gives the same picture."""

import warp as wp

from visthrow.detector_training.scenes import textures

LENS_STEPS = wp.constant(12)  # Newton's steps to the angle of a pixel; the lens is monotonic

MIPS = wp.constant(textures.MIPS)
SIZE = wp.constant(textures.SIZE)


@wp.func
def angle_of(radius: float, k: wp.vec4, limit: float) -> float:
    """Angle off the axis at a distance from the principal point, theta_d [rad]."""
    theta = wp.min(radius, limit)
    for _ in range(LENS_STEPS):
        t2 = theta * theta
        value = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
        slope = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])))
        theta = wp.clamp(theta - (value - radius) / wp.max(slope, 0.05), 0.0, limit)
    return theta


@wp.func
def mirrored(x: float) -> float:
    """A coordinate folded into 0 to 1: photographs do not tile, their mirror images do."""
    y = x - 2.0 * wp.floor(0.5 * x)
    return wp.where(y > 1.0, 2.0 - y, y)


@wp.func
def texel(
    textures: wp.array2d(dtype=wp.uint8), which: int, base: int, size: int, x: int, y: int
) -> wp.vec3:
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
    textures: wp.array2d(dtype=wp.uint8),
    which: int,
    u: float,
    v: float,
    footprint: float,
    chance: float,
) -> wp.vec3:
    """Bilinear colour of a texture at u, v [tiles]; ``footprint`` of the sample [tiles], ``chance``
    rounds the level.
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
    x = mirrored(u) * float(size - 1)
    y = mirrored(v) * float(size - 1)
    i = int(x)
    j = int(y)
    a = x - float(i)
    b = y - float(j)
    top = (
        texel(textures, which, base, size, i, j) * (1.0 - a)
        + texel(textures, which, base, size, i + 1, j) * a
    )
    low = (
        texel(textures, which, base, size, i, j + 1) * (1.0 - a)
        + texel(textures, which, base, size, i + 1, j + 1) * a
    )
    return top * (1.0 - b) + low * b


@wp.func
def sphere(eye: wp.vec3, ray: wp.vec3, centre: wp.vec3, radius: float) -> float:
    """Distance to a ball along a ray, or a large number."""
    offset = centre - eye
    distance = wp.dot(ray, offset)
    discriminant = radius * radius - wp.dot(offset, offset) + distance * distance
    hit = discriminant > 0.0 and distance > 0.0
    return wp.where(hit, distance - wp.sqrt(wp.max(discriminant, 0.0)), 1.0e9)


@wp.func
def lit(normal: wp.vec3, light: wp.vec3, ambient: float) -> float:
    return ambient + (1.0 - ambient) * wp.max(wp.dot(normal, light), 0.0)


@wp.func
def felt(normal: wp.vec3, turn: wp.quat, colour: wp.vec3, seam: wp.vec3) -> wp.vec3:
    """A tennis ball: felt with a seam."""
    n = wp.quat_rotate_inv(turn, normal)
    off = wp.abs(n[2] - 0.45 * wp.sin(2.0 * wp.atan2(n[1], n[0])))
    return wp.where(off < 0.09, seam, colour)


@wp.func
def square(
    x: float,
    y: float,
    side: float,
    rim: float,
    mark: int,
    field: wp.vec3,
    edge: wp.vec3,
    dark: wp.vec3,
    below: wp.vec3,
) -> wp.vec3:
    """The goal square at a place from its centre, on its own axes [m], or what lies below it."""
    reach = wp.max(wp.abs(x), wp.abs(y))
    half = 0.5 * side
    inner = half - rim
    colour = wp.where(reach < half, edge, below)
    colour = wp.where(reach < inner, field, colour)
    marked = bool(False)
    if mark == 1:
        marked = wp.min(wp.abs(x), wp.abs(y)) < 0.06 * side
    if mark == 2:
        marked = x * x + y * y < 0.04 * side * side
    if mark == 3:
        marked = wp.abs(x) + wp.abs(y) < 0.3 * side and wp.abs(x) + wp.abs(y) > 0.2 * side
    return wp.where(marked and reach < inner, dark, colour)


@wp.func
def on_ground(
    e: int,
    point: wp.vec3,
    depth: float,
    grazing: float,
    pixel: float,
    chance: float,
    goal: wp.array2d(dtype=float),
    ball: wp.array2d(dtype=float),
    ground: wp.array2d(dtype=float),
    light: wp.array2d(dtype=float),
    things: wp.array3d(dtype=float),
    textures: wp.array2d(dtype=wp.uint8),
    eye: wp.vec3,
) -> wp.vec3:
    """Colour of the ground: texture, what lies on it, the square, the shadows of ball
    and vehicle.
    """
    c = wp.cos(ground[e, 2])
    s = wp.sin(ground[e, 2])
    u = (c * point[0] + s * point[1]) / ground[e, 1] + ground[e, 3]
    v = (c * point[1] - s * point[0]) / ground[e, 1] + ground[e, 4]
    footprint = depth * pixel / (wp.max(grazing, 0.03) * ground[e, 1])
    colour = texture(textures, int(ground[e, 0]), u, v, footprint, chance)
    colour = wp.cw_mul(colour, wp.vec3(ground[e, 5], ground[e, 6], ground[e, 7]))
    for i in range(things.shape[1]):
        kind = int(things[e, i, 0])
        if kind == 1 or kind == 2:
            tc = wp.cos(things[e, i, 6])
            ts = wp.sin(things[e, i, 6])
            dx = point[0] - things[e, i, 1]
            dy = point[1] - things[e, i, 2]
            lateral = (tc * dx + ts * dy) / things[e, i, 4]
            axial = (tc * dy - ts * dx) / things[e, i, 5]
            covered = wp.where(
                kind == 1,
                lateral * lateral + axial * axial < 1.0,
                wp.max(wp.abs(lateral), wp.abs(axial)) < 1.0,
            )
            if covered:
                colour = wp.vec3(things[e, i, 7], things[e, i, 8], things[e, i, 9])
                rim = wp.max(wp.abs(lateral), wp.abs(axial)) > things[e, i, 10]
                colour = wp.where(
                    rim, wp.vec3(things[e, i, 11], things[e, i, 11], things[e, i, 11]), colour
                )
    gc = wp.cos(goal[e, 3])
    gs = wp.sin(goal[e, 3])
    dx = point[0] - goal[e, 0]
    dy = point[1] - goal[e, 1]
    field = wp.vec3(goal[e, 6], goal[e, 7], goal[e, 8])
    edge = wp.vec3(goal[e, 9], goal[e, 10], goal[e, 11])
    dark = wp.vec3(goal[e, 12], goal[e, 13], goal[e, 14])
    colour = square(
        gc * dx + gs * dy,
        gc * dy - gs * dx,
        goal[e, 2],
        goal[e, 4],
        int(goal[e, 5]),
        field,
        edge,
        dark,
        colour,
    )
    dir = wp.vec3(light[e, 0], light[e, 1], light[e, 2])
    for body in range(2):
        high = wp.where(body == 0, wp.vec3(ball[e, 0], ball[e, 1], ball[e, 2]), eye)
        size = wp.where(body == 0, ball[e, 3], 0.09)
        x = point[0] - high[0] + dir[0] / dir[2] * high[2]
        y = point[1] - high[1] + dir[1] / dir[2] * high[2]
        soft = size + 0.15 * high[2]
        strength = light[e, 7] * size / soft
        colour = colour * (1.0 - strength * wp.exp(-(x * x + y * y) / (soft * soft)))
    return colour * lit(wp.vec3(0.0, 0.0, 1.0), dir, light[e, 3])


@wp.func
def on_walls(
    e: int,
    eye: wp.vec3,
    ray: wp.vec3,
    pixel: float,
    chance: float,
    walls: wp.array2d(dtype=float),
    textures: wp.array2d(dtype=wp.uint8),
) -> wp.vec3:
    """Walls and ceiling of the hall, a box with a photograph on each side."""
    tx = (wp.where(ray[0] > 0.0, walls[e, 1], -walls[e, 1]) - eye[0]) / wp.where(
        wp.abs(ray[0]) < 1.0e-6, 1.0e-6, ray[0]
    )
    ty = (wp.where(ray[1] > 0.0, walls[e, 1], -walls[e, 1]) - eye[1]) / wp.where(
        wp.abs(ray[1]) < 1.0e-6, 1.0e-6, ray[1]
    )
    tz = wp.where(ray[2] > 1.0e-4, (walls[e, 2] - eye[2]) / wp.max(ray[2], 1.0e-4), 1.0e9)
    depth = wp.min(wp.min(tx, ty), tz)
    point = eye + ray * depth
    u = wp.where(depth == tx, point[1], point[0])
    v = wp.where(depth == tz, point[1], point[2])
    colour = texture(
        textures,
        int(walls[e, 0]),
        u / walls[e, 3],
        v / walls[e, 3],
        depth * pixel / walls[e, 3],
        chance,
    )
    return colour * walls[e, 4]


@wp.func
def radiance(
    e: int,
    eye: wp.vec3,
    ray: wp.vec3,
    centre: wp.vec3,
    pixel: float,
    chance: float,
    ball: wp.array2d(dtype=float),
    goal: wp.array2d(dtype=float),
    ground: wp.array2d(dtype=float),
    walls: wp.array2d(dtype=float),
    light: wp.array2d(dtype=float),
    rope: wp.array2d(dtype=float),
    things: wp.array3d(dtype=float),
    textures: wp.array2d(dtype=wp.uint8),
) -> wp.vec3:
    """Light along a ray; nearest first: rope, ball, other balls, ground, walls."""
    dir = wp.vec3(light[e, 0], light[e, 1], light[e, 2])
    if ray[2] < -1.0e-4:
        depth = -eye[2] / ray[2]
        colour = on_ground(
            e,
            eye + ray * depth,
            depth,
            -ray[2],
            pixel,
            chance,
            goal,
            ball,
            ground,
            light,
            things,
            textures,
            eye,
        )
    else:
        depth = 1.0e8
        colour = on_walls(e, eye, ray, pixel, chance, walls, textures)
    for i in range(things.shape[1]):
        if int(things[e, i, 0]) == 3:
            place = wp.vec3(things[e, i, 1], things[e, i, 2], things[e, i, 3])
            sphere_depth = sphere(eye, ray, place, things[e, i, 4])
            if sphere_depth < depth:
                depth = sphere_depth
                normal = (eye + ray * sphere_depth - place) / things[e, i, 4]
                colour = wp.vec3(things[e, i, 7], things[e, i, 8], things[e, i, 9]) * lit(
                    normal, dir, light[e, 3]
                )
    sphere_depth = sphere(eye, ray, centre, ball[e, 3])
    if sphere_depth < depth:
        depth = sphere_depth
        normal = (eye + ray * sphere_depth - centre) / ball[e, 3]
        turn = wp.quat(ball[e, 7], ball[e, 8], ball[e, 9], ball[e, 10])
        shade = felt(
            normal,
            turn,
            wp.vec3(ball[e, 11], ball[e, 12], ball[e, 13]),
            wp.vec3(ball[e, 14], ball[e, 15], ball[e, 16]),
        )
        colour = shade * lit(normal, dir, light[e, 3])
    if rope[e, 3] > 0.0:
        top = wp.vec3(rope[e, 0], rope[e, 1], rope[e, 2]) + eye
        way = centre - top
        sideways = wp.cross(ray, way)
        gap = wp.abs(wp.dot(top - eye, sideways)) / wp.max(wp.length(sideways), 1.0e-9)
        a = wp.dot(way, way)
        b = wp.dot(ray, way)
        off = top - eye
        share = (b * wp.dot(off, ray) - wp.dot(off, way)) / wp.max(a - b * b, 1.0e-9)
        reach = wp.dot(ray, off + way * share)
        if gap < rope[e, 3] and share > 0.0 and share < 1.0 and reach > 0.0 and reach < depth:
            colour = wp.vec3(rope[e, 4], rope[e, 5], rope[e, 6])
    return wp.cw_mul(colour, wp.vec3(light[e, 4], light[e, 5], light[e, 6]))


@wp.kernel
def render(
    # In:
    seed: int,
    samples: int,
    lens: wp.array2d(dtype=float),
    pose: wp.array2d(dtype=float),
    shutter: wp.array2d(dtype=float),
    ball: wp.array2d(dtype=float),
    goal: wp.array2d(dtype=float),
    ground: wp.array2d(dtype=float),
    walls: wp.array2d(dtype=float),
    light: wp.array2d(dtype=float),
    rope: wp.array2d(dtype=float),
    sensor: wp.array2d(dtype=float),
    things: wp.array3d(dtype=float),
    textures: wp.array2d(dtype=wp.uint8),
    # Out:
    image: wp.array4d(dtype=wp.uint8),
):
    """Render a pixel; see the module."""
    e, v, u = wp.tid()
    height = float(image.shape[1])
    chance = wp.rand_init(seed + int(sensor[e, 5]), (v * image.shape[2] + u))
    k = wp.vec4(lens[e, 4], lens[e, 5], lens[e, 6], lens[e, 7])
    field_limit = lens[e, 8]
    t2 = field_limit * field_limit
    edge = field_limit * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
    pixel = 1.0 / lens[e, 0]
    quat = wp.quat(pose[e, 3], pose[e, 4], pose[e, 5], pose[e, 6])
    rate = wp.vec3(pose[e, 10], pose[e, 11], pose[e, 12])
    row = ((float(v) + 0.5) / height - 0.5) * shutter[e, 1]
    total = wp.vec3()
    for i in range(samples):
        time = row + shutter[e, 0] * ((float(i) + wp.randf(chance)) / float(samples) - 0.5)
        x = (
            float(u) + wp.randf(chance) - 0.5 + shutter[e, 2] * wp.randn(chance) - lens[e, 2]
        ) / lens[e, 0]
        y = (
            float(v) + wp.randf(chance) - 0.5 + shutter[e, 2] * wp.randn(chance) - lens[e, 3]
        ) / lens[e, 1]
        radius = wp.sqrt(x * x + y * y)
        level = wp.randf(chance)
        if radius <= edge:
            theta = angle_of(radius, k, field_limit)
            scale = wp.where(radius > 1.0e-6, wp.sin(theta) / wp.max(radius, 1.0e-6), 1.0)
            ray_c = wp.vec3(x * scale, y * scale, wp.cos(theta))
            angle = wp.length(rate) * time
            turned = quat * wp.quat_from_axis_angle(
                wp.normalize(rate + wp.vec3(1.0e-9, 0.0, 0.0)), angle
            )
            ray = wp.quat_rotate(turned, ray_c)
            eye = wp.vec3(
                pose[e, 0] + pose[e, 7] * time,
                pose[e, 1] + pose[e, 8] * time,
                pose[e, 2] + pose[e, 9] * time,
            )
            centre = wp.vec3(
                ball[e, 0] + ball[e, 4] * time,
                ball[e, 1] + ball[e, 5] * time,
                ball[e, 2] + ball[e, 6] * time,
            )
            incoming = radiance(
                e,
                eye,
                ray,
                centre,
                pixel,
                level,
                ball,
                goal,
                ground,
                walls,
                light,
                rope,
                things,
                textures,
            )
            total += incoming * wp.pow(wp.max(wp.cos(0.5 * theta), 0.0), lens[e, 9])
    colour = total * (sensor[e, 0] / float(samples))
    for c in range(3):
        value = (
            colour[c]
            + wp.sqrt(wp.max(colour[c], 0.0)) * sensor[e, 1] * wp.randn(chance)
            + sensor[e, 2] * wp.randn(chance)
        )
        value = wp.pow(wp.clamp(value, 0.0, 1.0), sensor[e, 3])
        image[e, v, u, c] = wp.uint8(value * 255.0 + 0.5)
