"""The replay as one kernel: a lane flies one window of a recorded flight from a state of its own
with parameters of its own.

Every switch of the command, the latch, the separation and the knots of the latent forces end a step
exactly; measured stamps lie inside steps and are read from the cubic through both ends. One thread
a lane, no atomics."""

from dataclasses import dataclass

import warp as wp

from sim.kernels import state as st
from sim.kernels.laws import build_laws
from sim.kernels.quadrotor.rigid_body import build_flow
from sim.kernels.quadrotor.thrust import rotor_thrust
from sim.kernels.replay.sampling import build_sampling
from sim.kernels.rope.chain import build_chain
from sim.kernels.rope.coupling import build_coupled_step
from sim.kernels.rope.loose import build_loose_step
from sim.kernels.rope.payload import build_flight, build_payload
from sim.kernels.rope.release import build_letting_go, build_step_in_flight
from sim.kernels.structs import EXTENSIONS, Types, make_struct
from sim.params import LawParams, SensingParams, VehicleParams

EVERYTHING = frozenset(
    EXTENSIONS
)  # the replay has every extension built in, so that lanes may differ in all of them

ATTACHED, LOOSE, NO_PAYLOAD = 1, 0, 2  # how the payload starts: on the rope, flying, or not there

STATE_FIELDS = st.QUAD_FIELDS | {
    "cable_dir_w": ("vec3", True),
    "cable_vel_w": ("vec3", True),
    "stiffness": ("real", True),
    "payload_pos_w": ("vec3", False),  # where it starts loose, and where it is at the end
    "payload_vel_w": ("vec3", False),
    "slack_first": ("real", False),  # at the end alone: when the rope first went slack [s]
    "slack_last": (
        "real",
        False,
    ),  # and when it last came taut again; before the window's start if it did not
}

# share of the payload's weight below which the rope counts as slack: its shape is then anyone's
# guess
SLACK = 0.15

WINDOW_FIELDS = {
    "start": ("real", False),  # [s], clock of the flight
    "end": ("real", False),
    "first_knot": ("real", False),  # of the latent forces
    "knots": ("int", False),
    "payload": ("int", False),  # ATTACHED, LOOSE or NO_PAYLOAD
    "latch": ("real", False),  # of the release, any time after the end if none
    "clock_zero": ("real", False),  # start of the flight
    "command_first": ("int", False),  # range of the flight's commands
    "command_last": ("int", False),
    "vehicle_first": ("int", False),  # ranges of the measured stamps of this window
    "vehicle_count": ("int", False),
    "payload_first": ("int", False),
    "payload_count": ("int", False),
    "gyro_first": ("int", False),
    "gyro_count": ("int", False),
}

LANE_FIELDS = {
    "window": ("int", False),
    "plant": ("int", False),  # row of the parameters
    "state": ("int", False),  # row of the initial states
    "axis": (
        "int",
        False,
    ),  # of its latent force: 0-2 vehicle force, 3-5 vehicle torque, 6-8 payload force, or -1
    "knot": ("int", False),
    "size": ("real", False),  # of the latent force at its knot [N], [N m]
    "substep": ("real", False),  # largest step [s]
    "keep": ("int", False),  # first row of its knots' states in the knot arrays, or -1
    "resume": (
        "int",
        False,
    ),  # row of the knot arrays at which it leaves the lane that kept it, or -1
    "parent": ("int", False),  # that lane, flown before, of the same window, plant and state
    "shared": (
        "int",
        False,
        # of a lane from a start: so many after it share its flight and differ in what sensors show
        # of it
    ),
}

KNOT_FIELDS = {
    "pos_w": ("vec3", False),
    "vel_w": ("vec3", False),
    "quat_wb": ("quat", False),
    "rate_b": ("vec3", False),
    "thrust": ("real", False),
    "payload_pos_w": ("vec3", False),
    "payload_vel_w": ("vec3", False),
    "tension": ("real", False),
}

DATA_FIELDS = {
    "command_time": ("real", False),
    "command": ("vec4", False),
    "vehicle_time": ("real", False),
    "vehicle_quat": ("quat", False),  # measured; attitudes are told against them
    "payload_time": ("real", False),
    "gyro_time": ("real", False),
}


@dataclass(frozen=True)
class ReplayKernel:
    """The kernel of one choice of blocks and the structs that it takes."""

    replay: wp.Kernel
    State: type
    Windows: type
    Lanes: type
    Knots: type
    Data: type
    Sensing: type
    Moment: type
    Pointers: type


def build_replay(
    t: Types, vehicle: VehicleParams, segments: int, laws: tuple[LawParams, ...] = ()
) -> ReplayKernel:
    """Compose the kernel for a vehicle's kinds of blocks, the rope's segments and the plant's laws;
    numbers are read at run time.
    """
    real = t.real
    vec3 = t.vec3
    Vectors = t.Vectors
    Vehicle = t.Vehicle
    Rope = t.Rope
    Release = t.Release
    Air = t.Air
    QuadState = t.QuadState
    L = segments
    State = st.array_struct(t, "ReplayState", STATE_FIELDS)
    Windows = st.array_struct(t, "Windows", WINDOW_FIELDS)
    Lanes = st.array_struct(t, "Lanes", LANE_FIELDS)
    Knots = st.array_struct(t, "Knots", KNOT_FIELDS)
    Data = st.array_struct(t, "Recorded", DATA_FIELDS)
    Sensing = t.from_dataclass(SensingParams, {})
    flow, rate, motor_advance = build_flow(t, vehicle, EVERYTHING)
    chain = build_chain(t, L, EVERYTHING)
    payload = build_payload(t, EVERYTHING)
    coupled = build_coupled_step(t, flow, rate, motor_advance, chain, payload, EVERYTHING)
    extra = build_laws(t, laws, flow, chain, coupled.mount_velocity)
    flight_acceleration = build_flight(t, payload, extra)
    loose_step = build_loose_step(t, chain, payload)
    leaving = build_letting_go(t, EVERYTHING)
    fly_ball = build_step_in_flight(t, flight_acceleration)
    sampling = build_sampling(t, Sensing, Windows, Data)
    Steps = sampling.Steps
    Pointers = sampling.Pointers
    sample = sampling.sample
    copy_samples = sampling.copy_samples
    load_quad, store_quad = st.build_access(t, State)
    Ball = make_struct(
        "Ball",
        {"pos": vec3, "vel": vec3, "root": vec3, "root_vel": vec3, "tail": vec3, "tail_vel": vec3},
    )
    Moment = make_struct(
        "Moment",
        {
            "time": real,
            "quad": QuadState,
            "rope": Rope,
            "ball": Ball,
            "total": vec3,
            "before": vec3,
            "pay": vec3,
            "pay_vel": vec3,
            "separation": real,
            "mode": wp.int32,
            "latched": wp.int32,
            "knot": wp.int32,
            "slack": wp.int32,
            "at": Pointers,
        },
    )
    attached_code = ATTACHED
    loose_code = LOOSE

    @wp.func
    def push_at(air: Air, axis: int, size: real, share: real):
        """The latent force of a lane at a share of its peak."""
        out = air
        force = vec3()
        if axis >= 0:
            force[axis % 3] = size * wp.max(share, real(0.0))
        if axis >= 6:
            out.payload_push_w = force
        elif axis >= 3:
            out.twist_b = force
        else:
            out.push_w = force
        return out

    @wp.func
    def payload_now(r: Release, ball: Ball):
        return ball.pos + r.rope_tail * (ball.tail - ball.pos), ball.vel + r.rope_tail * (
            ball.tail_vel - ball.vel
        )

    @wp.func
    def let_go(r: Release, rope: Rope, s: QuadState, n: Vectors, u: Vectors):
        """The payload and the loose rope at the separation."""
        ball = Ball()
        ball.root = s.pos_w + wp.quat_rotate(s.quat_wb, rope.mount)
        ball.root_vel = coupled.mount_velocity(rope, s)
        pos, vel = chain.payload(rope, ball.root, ball.root_vel, n, u)
        ball.pos = pos
        ball.vel = leaving.kick(r, vel, n[L - 1])
        ball.root_vel = ball.root_vel + (ball.vel - vel)
        ball.tail = pos
        ball.tail_vel = ball.vel
        return ball

    @wp.func
    def knot_of(
        knots: Knots,
        row: int,
        p: Vehicle,
        rope: Rope,
        s: QuadState,
        pos: vec3,
        vel: vec3,
        pull: real,
    ):
        knots.pos_w[row] = s.pos_w
        knots.vel_w[row] = s.vel_w
        knots.quat_wb[row] = s.quat_wb
        knots.rate_b[row] = s.rate_b
        f = rotor_thrust(p, s.motor_speed, s.voltage)
        knots.thrust[row] = f[0] + f[1] + f[2] + f[3]
        knots.payload_pos_w[row] = pos
        knots.payload_vel_w[row] = vel
        knots.tension[row] = pull

    @wp.kernel(module="unique", enable_backward=False)
    def replay_kernel(
        # Params:
        vehicles: wp.array(dtype=Vehicle),
        ropes: wp.array(dtype=Rope),
        releases: wp.array(dtype=Release),
        airs: wp.array(dtype=Air),
        sensings: wp.array(dtype=Sensing),
        knot_spacing: real,
        gamma: real,
        max_turn: real,
        gravity: real,
        # State in:
        starts: State,
        # In:
        windows: Windows,
        lanes: Lanes,
        data: Data,
        order: wp.array(dtype=wp.int32),
        first_lane: int,
        # State out:
        ends: State,
        knots: Knots,
        marks: wp.array(dtype=Pointers),
        moments: wp.array(dtype=Moment),
        moment_dirs: wp.array2d(dtype=vec3),
        moment_vels: wp.array2d(dtype=vec3),
        moment_stiffness: wp.array2d(dtype=real),
        # Out:
        out: wp.array2d(dtype=vec3),
    ):
        lane = order[wp.tid() + first_lane]
        w = lanes.window[lane]
        row = lanes.plant[lane]
        p = vehicles[row]
        natural = ropes[row]
        r = releases[row]
        air = airs[row]
        x = sensings[row]
        g = vec3(real(0.0), real(0.0), -gravity)
        start = lanes.state[lane]
        s = load_quad(starts, start)
        n = wp.zeros(shape=(L,), dtype=vec3)
        u = wp.zeros(shape=(L,), dtype=vec3)
        stiffness = wp.zeros(shape=(L,), dtype=real)
        for i in range(L):
            n[i] = starts.cable_dir_w[i, start]
            u[i] = starts.cable_vel_w[i, start]
            stiffness[i] = starts.stiffness[i, start]
        rope = chain.stretched(natural, natural, stiffness, u, real(0.0))
        mode = windows.payload[w]
        ball = Ball()
        if mode != attached_code:
            rope = natural
            ball.pos = starts.payload_pos_w[start]
            ball.vel = starts.payload_vel_w[start]
            arm, arm_vel = chain.payload(rope, vec3(), vec3(), n, u)
            ball.root = ball.pos - arm
            ball.root_vel = ball.vel - arm_vel
            ball.tail = ball.pos
            ball.tail_vel = ball.vel

        tiny = real(1.0e-9)
        time = windows.start[w]
        end = windows.end[w]
        command = windows.command_first[w]
        delay = p.queue.delay
        while (
            command + 1 < windows.command_last[w]
            and data.command_time[command + 1] + delay <= time + tiny
        ):
            command = command + 1
        latch = windows.latch[w]
        separation = end + real(1.0)
        latched = mode != attached_code
        if mode == attached_code and latch <= time:
            separation = wp.max(
                latch + r.lag, time
            )  # the pull at the latch lies before this window
            latched = True
        knot = int(0)
        slack = bool(False)
        slack_first = time - real(1.0)
        slack_last = time - real(1.0)
        pointers = Pointers()
        pointers.due = time
        for e in range(lane + 1, lane + 1 + lanes.shared[lane]):
            marks[e] = pointers
        total = coupled.momentum(p, rope, s, u)
        before = s.rate_b
        pay = ball.pos
        pay_vel = ball.vel
        if mode == attached_code:
            pos0, vel0 = coupled.payload(rope, s, n, u)
            pay = pos0
            pay_vel = vel0
        resume = lanes.resume[lane]
        if resume >= 0:
            m = moments[resume]
            time = m.time
            s = m.quad
            rope = m.rope
            ball = m.ball
            total = m.total
            before = m.before
            pay = m.pay
            pay_vel = m.pay_vel
            separation = m.separation
            mode = m.mode
            latched = m.latched != 0
            slack = m.slack != 0
            knot = m.knot
            pointers = m.at
            for i in range(L):
                n[i] = moment_dirs[resume, i]
                u[i] = moment_vels[resume, i]
                stiffness[i] = moment_stiffness[resume, i]
            copy_samples(windows, w, pointers, lanes.parent[lane], lane, out)
        while time < end - tiny:
            until = end
            while (
                command + 1 < windows.command_last[w]
                and data.command_time[command + 1] + delay <= time + tiny
            ):
                command = command + 1
            if command + 1 < windows.command_last[w]:
                until = wp.min(until, data.command_time[command + 1] + delay)
            if mode == attached_code and latch > time + tiny:
                until = wp.min(until, latch)
            if mode == attached_code and latch <= time + tiny and not latched:
                separation = latch + leaving.lag(r, rope, chain.pull(rope, stiffness, u), gravity)
                latched = True
            if mode == attached_code and separation <= time + tiny:
                ball = let_go(r, rope, s, n, u)
                mode = int(loose_code)
                rope = natural
                pay = ball.pos
                pay_vel = ball.vel
            if mode == attached_code:
                until = wp.min(until, separation)
            knot_time = windows.first_knot[w] + real(float(knot)) * knot_spacing
            if knot < windows.knots[w]:
                if knot_time <= time + tiny:
                    if lanes.keep[lane] >= 0:
                        knot_index = lanes.keep[lane] + knot
                        knot_of(
                            knots,
                            knot_index,
                            p,
                            rope,
                            s,
                            pay,
                            pay_vel,
                            chain.pull(rope, stiffness, u),
                        )
                        if knot_index < moments.shape[0]:
                            moment = Moment()
                            moment.time = time
                            moment.quad = s
                            moment.rope = rope
                            moment.ball = ball
                            moment.total = total
                            moment.before = before
                            moment.pay = pay
                            moment.pay_vel = pay_vel
                            moment.separation = separation
                            moment.mode = mode
                            moment.latched = int(latched)
                            moment.slack = int(slack)
                            moment.knot = knot
                            moment.at = pointers
                            moments[knot_index] = moment
                            for i in range(L):
                                moment_dirs[knot_index, i] = n[i]
                                moment_vels[knot_index, i] = u[i]
                                moment_stiffness[knot_index, i] = stiffness[i]
                    knot = knot + 1
                    knot_time = knot_time + knot_spacing
                until = wp.min(until, wp.max(knot_time, time + tiny))
            count = wp.max(int(wp.ceil((until - time) / lanes.substep[lane] - real(1.0e-3))), 1)
            h = (until - time) / real(float(count))
            active = data.command[command]
            peak = windows.first_knot[w] + real(float(lanes.knot[lane])) * knot_spacing
            for j in range(count):
                t0 = time + real(float(j)) * h
                distance = wp.abs(t0 + real(0.5) * h - peak) / knot_spacing
                hanging = int(0)
                if mode == attached_code:
                    hanging = 1
                    rope = chain.stretched(natural, rope, stiffness, u, h)
                pushed = push_at(air, lanes.axis[lane], lanes.size[lane], real(1.0) - distance)
                pushed = extra.on(p, rope, pushed, s, n, u, stiffness, active, hanging)
                old = s
                old_pay = pay
                old_pay_vel = pay_vel
                if mode == attached_code:
                    s, total, fell_back = coupled.step(
                        p, rope, pushed, s, total, active, n, u, stiffness, g, gamma, max_turn, h
                    )
                    pos1, vel1 = coupled.payload(rope, s, n, u)
                    pay = pos1
                    pay_vel = vel1
                    if chain.pull(rope, stiffness, u) < real(SLACK) * rope.payload_mass * gravity:
                        slack = True
                        if slack_first < windows.start[w]:
                            slack_first = t0
                    elif slack:
                        slack = False
                        slack_last = t0 + h
                else:
                    s = coupled.step_alone(p, pushed, s, active, g, h)
                    if mode == loose_code:
                        flown_pos, flown_vel = fly_ball(rope, pushed, ball.pos, ball.vel, g, h)
                        ball.pos = flown_pos
                        ball.vel = flown_vel
                        if r.rope_tail > real(0.0):
                            root, root_vel = loose_step(
                                rope,
                                pushed,
                                ball.root,
                                ball.root_vel,
                                n,
                                u,
                                stiffness,
                                g,
                                gamma,
                                max_turn,
                                h,
                            )
                            tail_pos, tail_vel = chain.payload(rope, root, root_vel, n, u)
                            ball.root = root
                            ball.root_vel = root_vel
                            ball.tail = tail_pos
                            ball.tail_vel = tail_vel
                        pos2, vel2 = payload_now(r, ball)
                        pay = pos2
                        pay_vel = vel2
                k = Steps()
                k.t0 = t0
                k.t1 = t0 + h
                k.h = h
                last = j == count - 1 and until >= end - tiny
                if (
                    last or pointers.due <= k.t1
                ):  # most steps show nothing, and to ask costs as much as a tenth of a step
                    pointers = sample(
                        p,
                        x,
                        data,
                        windows,
                        w,
                        old,
                        s,
                        before,
                        old_pay,
                        old_pay_vel,
                        pay,
                        pay_vel,
                        k,
                        last,
                        pointers,
                        out,
                        lane,
                    )
                for e in range(lane + 1, lane + 1 + lanes.shared[lane]):
                    if last or marks[e].due <= k.t1:
                        marks[e] = sample(
                            p,
                            sensings[lanes.plant[e]],
                            data,
                            windows,
                            w,
                            old,
                            s,
                            before,
                            old_pay,
                            old_pay_vel,
                            pay,
                            pay_vel,
                            k,
                            last,
                            marks[e],
                            out,
                            e,
                        )
                before = old.rate_b
            time = until

        if lanes.keep[lane] >= 0:
            if knot < windows.knots[w]:
                knot_of(
                    knots,
                    lanes.keep[lane] + knot,
                    p,
                    rope,
                    s,
                    pay,
                    pay_vel,
                    chain.pull(rope, stiffness, u),
                )
            store_quad(ends, lane, s)
            ends.payload_pos_w[lane] = pay
            ends.payload_vel_w[lane] = pay_vel
            ends.slack_first[lane] = slack_first
            ends.slack_last[lane] = slack_last
            for i in range(L):
                ends.cable_dir_w[i, lane] = n[i]
                ends.cable_vel_w[i, lane] = u[i]
                ends.stiffness[i, lane] = stiffness[i]

    return ReplayKernel(
        replay_kernel, State, Windows, Lanes, Knots, Data, Sensing, Moment, Pointers
    )
