"""The replay kernel: each lane simulates a window of a recorded flight, with an initial state and
parameters of its own.

A step ends exactly at every change of the command, at the latch, the separation and the knots of
the latent forces. At measured stamps, the state is interpolated within a step by a cubic. There is
one thread per lane, and no atomics."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import warp as wp

from camera.warp_start import FLAGS
from sim.kernels import state as st
from sim.kernels.laws import build_laws
from sim.kernels.quadrotor.rigid_body import build_flow
from sim.kernels.quadrotor.thrust import rotor_thrust
from sim.kernels.replay.sampling import build_sampling, rotation_of_vector
from sim.kernels.rope.chain import build_chain
from sim.kernels.rope.coupling import build_coupled_step
from sim.kernels.rope.loose import build_loose
from sim.kernels.rope.release import lag
from sim.kernels.runtime import Ints, unique_kernel
from sim.kernels.structs import EXTENSIONS, QUAD_STATE, Types
from sim.params import LawParams, SensingParams, VehicleParams

# all extensions are built in, so that lanes may differ in any of them
EVERYTHING = frozenset(EXTENSIONS)

# state of the payload at the start: on the rope, in flight, or none
ATTACHED = 1
LOOSE = 0
NO_PAYLOAD = 2

STATE_FIELDS = {
    **QUAD_STATE,
    **st.ROPE_FIELDS,
    "payload_pos_w": "vec3",  # at the start, if loose, and at the end
    "payload_vel_w": "vec3",
    # only at the end: time at which the rope first became slack [s], and at which it last became
    # taut again; before the window's start if it did not
    "slack_first": "real",
    "slack_last": "real",
}

# tension per weight of the payload below which the rope is slack and its shape unknown
SLACK = 0.15

CPU_OPTIONS = (
    " -ffp-contract=fast -mreassociate -fno-signed-zeros -fno-slp-vectorize"
    " -mllvm=-inline-threshold=20000"
)
"""Options of the compiler for CPUs: fused multiply-add, as on a GPU, sums in any order, no
vectorisation of neighbouring scalars, and inlining of every function. NaN and infinity are
respected, since a diverging lane must end.
"""

TINY = 1.0e-9  # times [s] that differ by less are equal

WINDOW_FIELDS = {
    "start": "real",  # [s], clock of the flight
    "end": "real",
    "first_knot": "real",  # of the latent forces
    "knots": "int",
    "payload": "int",  # ATTACHED, LOOSE or NO_PAYLOAD
    "latch": "real",  # time of the release's latch; after the end if there is none
    "clock_zero": "real",  # start of the flight
    "command_first": "int",  # range of the flight's commands
    "command_last": "int",
    "vehicle_first": "int",  # ranges of the measured stamps of this window
    "vehicle_count": "int",
    "payload_first": "int",
    "payload_count": "int",
    "gyro_first": "int",
    "gyro_count": "int",
}

LANE_FIELDS = {
    "window": "int",
    "plant": "int",  # row of the parameters
    "state": "int",  # row of the initial states
    # component of the latent force: 0-2 vehicle force, 3-5 vehicle torque, 6-8 payload force; -1:
    # none
    "axis": "int",
    "knot": "int",  # of the latent force
    "size": "real",  # of the latent force at its knot [N], [N m]
    "substep": "real",  # largest step [s]
    "keep": "int",  # first row of the states at its knots in the knot arrays; -1: not kept
    "resume": "int",  # row of the knot arrays from which it continues the parent; -1: from a start
    "parent": "int",  # lane simulated before, with the same window, plant and state
    "skip": "int",  # command that is left out, the one before acts on; -1: none
    # number of lanes after this one that share its flight and differ only in the sensing
    "shared": "int",
}

KNOT_FIELDS = {
    "pos_w": "vec3",
    "vel_w": "vec3",
    "quat_wb": "quat",
    "rate_b": "vec3",
    "thrust": "real",
    "payload_pos_w": "vec3",
    "payload_vel_w": "vec3",
    "tension": "real",
}

DATA_FIELDS = {
    "command_time": "real",
    "command": "vec4",
    "vehicle_time": "real",
    "vehicle_quat": "quat",  # measured; attitudes are expressed relative to them
    "payload_time": "real",
    "gyro_time": "real",
}

IMPOSED_FIELDS = {
    "thrust_rate": "real",  # of all motors together [N/s]
    "attitude": "quat",  # at the command's time
    "turn_b": "vec3",  # rate of that attitude while the command acts [rad/s]
    "turn_acc_b": "vec3",  # angular acceleration in addition to that of torques [rad/s^2]
    "neighbour_pos_w": "vec3",  # measured position of a body that may push the vehicle [m]
}
"""Additional fields of each command, in a replay with imposed attitudes."""


@dataclass(frozen=True)
class ReplayKernel:
    """The kernel for a choice of blocks, and the structs that it takes."""

    replay: wp.Kernel
    State: type
    Windows: type
    Lanes: type
    Knots: type
    Data: type
    Sensing: type
    Moment: type
    Ropes: type  # of the moments, fields of state.ROPE_FIELDS
    Pointers: type


@wp.func
def push_at(air: Any, axis: int, size: Any, share: Any):
    """Return the air with the latent force of a lane; ``share``: of its size."""
    out = air
    force = air.push_w - air.push_w
    if axis >= 0:
        force[axis % 3] = size * wp.max(share, share - share)
    if axis >= 6:
        out.payload_push_w = force
    elif axis >= 3:
        out.twist_b = force
    else:
        out.push_w = force
    return out


@wp.func
def latest_command(windows: Any, w: int, data: Any, command: int, delay: Any, time: Any):
    """Return the index of the latest command that acts at ``time``, ``command`` or a later one."""
    latest = int(command)
    last = windows.command_last[w]
    while latest + 1 < last and data.command_time[latest + 1] + delay <= time:
        latest = latest + 1
    return latest


@wp.func
def next_event(m: Any, windows: Any, w: int, data: Any, command: int, delay: Any):
    """Return the time of the next event: a command begins to act, the latch opens, the payload
    separates, or the window ends.
    """
    until = windows.end[w]
    if command + 1 < windows.command_last[w]:
        until = wp.min(until, data.command_time[command + 1] + delay)
    if m.mode == ATTACHED:
        if windows.latch[w] > m.time + type(delay)(TINY):
            until = wp.min(until, windows.latch[w])
        until = wp.min(until, m.separation)
    return until


@wp.func
def note_slack(m: Any, pull: Any, weight: Any, begins: Any, t0: Any, t1: Any):
    """Return the lane with the state of its rope, slack or taut, updated after a step."""
    out = m
    if pull < type(pull)(SLACK) * weight:
        out.slack = 1
        if m.slack_first < begins:
            out.slack_first = t0
    elif m.slack != 0:
        out.slack = 0
        out.slack_last = t1
    return out


@wp.func
def imposed_attitude(like: Any, data: Any, command: int, time: Any):
    """Return the imposed attitude at a time in which a command acts, of the type of ``like``."""
    since = time - data.command_time[command]
    return data.attitude[command] * rotation_of_vector(like, since * data.turn_b[command])


def build_lane(t: Types, structs: SimpleNamespace, chain, coupled, loose, load_quad, load_rope):
    """Return Warp functions ``begin`` and ``latch_or_separate`` of a lane between two steps."""
    real = t.real
    Vectors = t.Vectors
    Reals = t.Reals
    Rope = t.Rope
    Release = t.Release
    Moment = structs.Moment
    attached_code = ATTACHED
    loose_code = LOOSE
    tiny = real(TINY)

    @wp.func
    def begin(
        p: t.Vehicle,
        natural: Rope,
        r: Release,
        windows: structs.Windows,
        w: int,
        starts: structs.State,
        start: int,
        n: Vectors,
        u: Vectors,
        stiffness: Reals,
    ):
        """Return a lane at the start of its window, and fill n, u and stiffness."""
        m = Moment()
        m.time = windows.start[w]
        m.quad = load_quad(starts, start)
        load_rope(starts, start, n, u, stiffness)
        m.mode = windows.payload[w]
        m.separation = windows.end[w] + real(1.0)
        if m.mode == attached_code:
            m.rope = chain.stretched(natural, natural, stiffness, u, real(0.0))
            pos, vel = coupled.payload(m.rope, m.quad, n, u)
            m.pay = pos
            m.pay_vel = vel
            if windows.latch[w] <= m.time:  # tension at the latch unknown
                m.separation = wp.max(windows.latch[w] + r.lag, m.time)
                m.latched = 1
        else:
            m.rope = natural
            m.pay = starts.payload_pos_w[start]
            m.pay_vel = starts.payload_vel_w[start]
            m.ball = loose.hang_below(natural, m.pay, m.pay_vel, n, u)
            m.latched = 1
        m.total = coupled.momentum(p, m.rope, m.quad, u)
        m.before = m.quad.rate_b
        m.slack_first = m.time - real(1.0)
        m.slack_last = m.slack_first
        m.at.due = m.time
        return m

    @wp.func
    def latch_or_separate(
        m: Moment,
        natural: Rope,
        r: Release,
        latch: real,
        n: Vectors,
        u: Vectors,
        stiffness: Reals,
        gravity: real,
    ):
        """Return the lane after the events of its release that are due: latch and separation."""
        out = m
        if m.mode == attached_code:
            if latch <= m.time + tiny and m.latched == 0:
                pull = chain.pull(m.rope, stiffness, u)
                out.separation = latch + lag(r, m.rope, pull, gravity)
                out.latched = 1
            if out.separation <= m.time + tiny:
                out.ball = loose.let_go(r, m.rope, m.quad, n, u)
                out.mode = int(loose_code)
                out.rope = natural
                out.pay = out.ball.pos
                out.pay_vel = out.ball.vel
        return out

    return begin, latch_or_separate


def build_keeping(t: Types, structs: SimpleNamespace, chain, store_quad, store_rope):
    """Build ``write_knot`` and ``write_end``, which store a lane's states at knots and at the
    end.
    """
    real = t.real
    Moment = structs.Moment
    Vectors = t.Vectors
    Reals = t.Reals

    @wp.func
    def write_knot(knots: structs.Knots, row: int, p: t.Vehicle, m: Moment, pull: real):
        knots.pos_w[row] = m.quad.pos_w
        knots.vel_w[row] = m.quad.vel_w
        knots.quat_wb[row] = m.quad.quat_wb
        knots.rate_b[row] = m.quad.rate_b
        f = rotor_thrust(p, m.quad.motor_speed, m.quad.voltage)
        knots.thrust[row] = f[0] + f[1] + f[2] + f[3]
        knots.payload_pos_w[row] = m.pay
        knots.payload_vel_w[row] = m.pay_vel
        knots.tension[row] = pull

    @wp.func
    def write_end(
        ends: structs.State,
        knots: structs.Knots,
        lane: int,
        first_row: int,
        count: int,
        p: t.Vehicle,
        m: Moment,
        n: Vectors,
        u: Vectors,
        stiffness: Reals,
    ):
        if m.knot < count:
            write_knot(knots, first_row + m.knot, p, m, chain.pull(m.rope, stiffness, u))
        store_quad(ends, lane, m.quad)
        ends.payload_pos_w[lane] = m.pay
        ends.payload_vel_w[lane] = m.pay_vel
        ends.slack_first[lane] = m.slack_first
        ends.slack_last[lane] = m.slack_last
        store_rope(ends, lane, n, u, stiffness)

    return write_knot, write_end


def build_replay(
    t: Types,
    vehicle: VehicleParams,
    segments: int,
    laws: tuple[LawParams, ...],
    imposed: bool,
) -> ReplayKernel:
    """Compose the kernel for a vehicle's kinds of blocks, the rope's segments and the plant's laws.
    Numbers are read at run time.

    ``imposed``: whether the vehicle follows recorded attitudes instead of those by its torques. Its
    rates are still simulated, and commands are motor speeds."""
    real = t.real
    vec3 = t.vec3
    L = segments
    State = st.array_struct(t, "ReplayState", STATE_FIELDS)
    Windows = st.array_struct(t, "Windows", WINDOW_FIELDS)
    Lanes = st.array_struct(t, "Lanes", LANE_FIELDS)
    Knots = st.array_struct(t, "Knots", KNOT_FIELDS)
    Data = st.array_struct(t, "Recorded", DATA_FIELDS | (IMPOSED_FIELDS if imposed else {}))
    Sensing = t.from_dataclass(SensingParams, {})
    Ropes = st.array_struct(t, "Ropes", st.ROPE_FIELDS)
    flow, advance = build_flow(t, vehicle, EVERYTHING, motors=imposed)
    chain = build_chain(t, L, EVERYTHING)
    coupled = build_coupled_step(t, flow, advance, chain, EVERYTHING)
    extra = build_laws(t, laws, flow, chain)
    load_quad, store_quad = st.build_access(t, State)
    load_rope, store_rope = st.build_rope_access(t, L)
    loose = build_loose(t, chain, extra)
    sampling = build_sampling(t, Sensing, Windows, Data, loose.Ball)
    Moment = sampling.Moment
    structs = SimpleNamespace(
        State=State,
        Windows=Windows,
        Lanes=Lanes,
        Knots=Knots,
        Data=Data,
        Sensing=Sensing,
        Moment=Moment,
        Ropes=Ropes,
        Pointers=sampling.Pointers,
    )
    begin, latch_or_separate = build_lane(t, structs, chain, coupled, loose, load_quad, load_rope)
    write_knot, write_end = build_keeping(t, structs, chain, store_quad, store_rope)
    attached_code = ATTACHED
    loose_code = LOOSE
    tiny = real(TINY)

    @unique_kernel(module_options={"cpu_compiler_flags": FLAGS + CPU_OPTIONS})
    def replay_kernel(
        # Params:
        plants: t.Plants,
        sensings: wp.array(dtype=Sensing),
        knot_spacing: real,
        # State in:
        starts: State,
        # In:
        windows: Windows,
        lanes: Lanes,
        data: Data,
        order: Ints,
        first_lane: int,
        # State out:
        ends: State,
        knots: Knots,
        marks: wp.array(dtype=structs.Pointers),
        moments: wp.array(dtype=Moment),
        moment_ropes: Ropes,
        # Out:
        out: wp.array2d(dtype=vec3),
    ):
        lane = order[wp.tid() + first_lane]
        w = lanes.window[lane]
        row = lanes.plant[lane]
        p = plants.vehicles[row]
        natural = plants.ropes[row]
        r = plants.releases[row]
        air = plants.airs[row]
        gravity = plants.gravity
        g = plants.gravity_w
        n = wp.zeros(L, vec3)
        u = wp.zeros(L, vec3)
        stiffness = wp.zeros(L, real)
        m = begin(p, natural, r, windows, w, starts, lanes.state[lane], n, u, stiffness)
        resume = lanes.resume[lane]
        if resume >= 0:
            m = moments[resume]
            load_rope(moment_ropes, resume, n, u, stiffness)
            sampling.copy_samples(windows, w, m.at, lanes.parent[lane], lane, out)
        after = lane + 1 + lanes.shared[lane]
        for e in range(lane, after):
            marks[e] = m.at
        end = windows.end[w]
        command = windows.command_first[w]
        delay = p.queue.delay
        while m.time < end - tiny:
            command = latest_command(windows, w, data, command, delay, m.time + tiny)
            m = latch_or_separate(m, natural, r, windows.latch[w], n, u, stiffness, gravity)
            until = next_event(m, windows, w, data, command, delay)
            if m.knot < windows.knots[w]:
                knot_time = windows.first_knot[w] + real(float(m.knot)) * knot_spacing
                if knot_time <= m.time + tiny:
                    if lanes.keep[lane] >= 0:
                        knot_row = lanes.keep[lane] + m.knot
                        write_knot(knots, knot_row, p, m, chain.pull(m.rope, stiffness, u))
                        if knot_row < moments.shape[0]:
                            m.at = marks[lane]
                            moments[knot_row] = m
                            store_rope(moment_ropes, knot_row, n, u, stiffness)
                    m.knot = m.knot + 1
                    knot_time = knot_time + knot_spacing
                until = wp.min(until, wp.max(knot_time, m.time + tiny))
            count = wp.max(int(wp.ceil((until - m.time) / lanes.substep[lane] - real(1.0e-3))), 1)
            h = (until - m.time) / real(float(count))
            acting = wp.where(command == lanes.skip[lane], command - 1, command)
            active = data.command[acting]
            peak = windows.first_knot[w] + real(float(lanes.knot[lane])) * knot_spacing
            for j in range(count):
                k = sampling.Steps()
                k.t0 = m.time + real(float(j)) * h
                k.t1 = k.t0 + h
                k.h = h
                if wp.static(imposed):  # the attitude in the middle of the step is the imposed one
                    half = real(0.5) * h
                    q = imposed_attitude(m.quad.quat_wb, data, command, k.t0 + half)
                    m.quad.quat_wb = q * rotation_of_vector(q, -half * m.quad.rate_b)
                k.quad = m.quad
                k.pay = m.pay
                k.pay_vel = m.pay_vel
                distance = wp.abs(k.t0 + real(0.5) * h - peak) / knot_spacing
                hanging = int(0)
                if m.mode == attached_code:
                    hanging = 1
                    m.rope = chain.stretched(natural, m.rope, stiffness, u, h)
                pushed = push_at(air, lanes.axis[lane], lanes.size[lane], real(1.0) - distance)
                if wp.static(imposed):
                    twist = wp.cw_mul(p.body.inertia, data.turn_acc_b[command])
                    pushed.twist_b = pushed.twist_b + twist
                    pushed.neighbour_pos_w = data.neighbour_pos_w[command]
                    pushed.thrust_rate = data.thrust_rate[command]
                pushed = extra.on(p, m.rope, pushed, k.quad, n, u, stiffness, active, hanging)
                if hanging != 0:
                    quad, total, _fell_back = coupled.step(
                        p,
                        m.rope,
                        pushed,
                        k.quad,
                        m.total,
                        active,
                        n,
                        u,
                        stiffness,
                        g,
                        plants.gamma,
                        plants.max_turn,
                        h,
                    )
                    m.quad = quad
                    m.total = total
                    pos, vel = coupled.payload(m.rope, quad, n, u)
                    m.pay = pos
                    m.pay_vel = vel
                    pull = chain.pull(m.rope, stiffness, u)
                    weight = m.rope.payload_mass * gravity
                    m = note_slack(m, pull, weight, windows.start[w], k.t0, k.t1)
                else:
                    m.quad = coupled.step_alone(p, pushed, k.quad, active, g, h)
                    if m.mode == loose_code:
                        m.ball = loose.fly(
                            m.ball,
                            m.rope,
                            r,
                            pushed,
                            n,
                            u,
                            stiffness,
                            g,
                            plants.gamma,
                            plants.max_turn,
                            h,
                        )
                        pos1, vel1 = loose.payload(r, m.ball)
                        m.pay = pos1
                        m.pay_vel = vel1
                if wp.static(imposed):
                    k.quad.quat_wb = imposed_attitude(q, data, command, k.t0)
                    m.quad.quat_wb = imposed_attitude(q, data, command, k.t1)
                last = j == count - 1 and until >= end - tiny
                for e in range(lane, after):
                    # most steps have no stamp, and the call costs a tenth of a step
                    if last or marks[e].due <= k.t1:
                        sensing = sensings[lanes.plant[e]]
                        marks[e] = sampling.sample(
                            p, sensing, data, windows, w, k, m, last, marks[e], out, e
                        )
                m.before = k.quad.rate_b
            m.time = until

        if lanes.keep[lane] >= 0:
            knot_count = windows.knots[w]
            write_end(ends, knots, lane, lanes.keep[lane], knot_count, p, m, n, u, stiffness)

    return ReplayKernel(replay_kernel, **vars(structs))
