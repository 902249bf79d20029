"""From the effects of a robot file to the constants and states of the compiled physics."""

from collections.abc import Iterable

import numpy as np

from emulator.arm import Body, Power, State
from emulator.effects.base import Base, Chain, at_rest, flexible, rigid
from emulator.effects.drive import Sensed, Sensing
from emulator.effects.environment import Environment, Touched
from emulator.effects.friction import Rows, Rubbed, bristles
from emulator.effects.motor import Motors, knee_of
from emulator.effects.period import LOAD_LAG_S, Memory, Physics
from emulator.effects.present import Present
from emulator.effects.thermal import Thermal, Warm
from emulator.effects.transmission import Shafts
from emulator.effects.unlisted import Unlisted
from emulator.kernels import Floats, Ints, bias
from protocols.errors import ConfigError
from protocols.robot import EffectEntry, Geometry, Robot

_TRANSMISSIONS = ("transmission.elasticity", "transmission.backlash")


def physics(present: Present, body: Body, period_s: float, substeps: int, q: Floats) -> Physics:
    """Constants of everything that the present effects need.

    Args:
        body: The arm without effects, payload and tilt included.
        q: Where it starts.
    """
    robot = present.robot
    h = period_s / substeps
    rotors, link = _split(present, body)
    chain, base = _chain(present, body, link, q)
    shafts = _shafts(present, rotors, len(base.stiffness))
    rows, brake_row = _rows(present, body, shafts, len(base.stiffness), h)
    return Physics(
        chain=chain,
        base=base,
        rotor=_rotor(present, shafts),
        offset_Nm=body.offset_Nm,
        brake_row=brake_row,
        brake_Nm=body.brake_Nm,
        load_lag=float(1 - np.exp(-h / LOAD_LAG_S)),
        rows=rows,
        shafts=shafts,
        motors=_motors(present),
        sensing=_sensing(present, h),
        environment=_environment(present),
        thermal=_thermal(present, period_s),
        unlisted=_unlisted(present, robot),
    )


def initial(physics: Physics, power: Power, q: Floats, substeps: int, ambient_C: float) -> tuple[State, Memory]:
    """At rest at q, base and shafts bent by the weight they carry."""
    chain, shafts = physics.chain, physics.shafts
    B, J, E, K = len(physics.base.stiffness), len(q), len(shafts.motor), len(physics.rows.joint)
    x = np.concatenate([at_rest(chain, physics.base, q), q, np.zeros(E)])
    weight = bias(chain.R0, chain.p0, chain.prismatic, chain.gravity, chain.link, x[: B + J], np.zeros(B + J))[B:]
    carried = np.linalg.solve(power.C.T, weight)
    for e in range(E):
        torque = carried[shafts.motor[e]]
        bent = torque / shafts.stiffness[e] + np.sign(torque) * shafts.gap[e] / 2
        x[shafts.rotor[e]] = power.C[shafts.motor[e]] @ q + bent
    xd, xdd = np.zeros_like(x), np.zeros_like(x)
    ring = substeps + 2 + int(np.ceil(physics.sensing.delay.max()))
    memory = Memory(
        x=x,
        xd=xd,
        xdd=xdd,
        impulse=np.zeros(K),
        load=weight.copy(),
        periods=np.zeros(1, dtype=np.int64),
        rubbed=Rubbed(np.zeros((K, len(physics.rows.limit))), np.zeros(K), np.zeros(K), np.zeros(K)),
        sensed=Sensed(np.zeros((J, ring)), np.zeros(1, dtype=np.int64), np.zeros(J)),
        touched=Touched(np.zeros(len(physics.environment.obstacle)), np.zeros(len(physics.environment.obstacle))),
        warm=Warm(np.full(J, ambient_C), np.full(J, ambient_C), np.zeros(J)),
        hidden=np.zeros(len(physics.unlisted.form)),
    )
    state = State(
        q=x[B : B + J],
        qd=xd[B : B + J],
        qdd=xdd[B : B + J],
        impulse=memory.impulse,
        current_A=np.zeros(J),
        integrator_V=np.zeros(J),
        target=np.zeros(J),
        following=np.zeros(J, dtype=np.int64),
        mean_A=np.zeros(J),
        counts=np.zeros(J),
        temperature_C=np.full(J, ambient_C),
    )
    return state, memory


def _chain(present: Present, body: Body, link: Floats, q: Floats) -> tuple[Chain, Base]:
    plain = Geometry(body.R0, body.p0, body.prismatic, body.gravity)
    for entry in present.of("base.flexibility"):
        p = entry.parameters
        return flexible(plain, link, q, p["frequency_Hz"], p["damping"], p["inertia_kgm2"], p["height_m"])
    return rigid(plain, link)


def _split(present: Present, body: Body) -> tuple[Floats, Floats]:
    """Inertia before and behind the springs: of all motors, shape (J,), and the links, shape (J, 10).

    Motor and link of a rigid axis cannot be told apart, so a file may give their sum to the link.

    Raises:
        ConfigError: Nothing is left for one of the two.
    """
    robot, link = present.robot, body.link.copy()
    rotors = np.array([joint.parameters.rotor_inertia_kgm2 for joint in robot.joint])
    for entry in (e for key in _TRANSMISSIONS for e in present.of(key)):
        j = present.joint(entry)
        column = 0 if body.prismatic[j] else 9  # mass, or zz
        before = entry.parameters["motor_inertia_kgm2"] or rotors[j] or link[j, column] / 4
        link[j, column] -= before - rotors[j]
        rotors[j] = before
        if before <= 0 or link[j, column] < 0:
            raise ConfigError(
                f"{robot.name}: {entry.effect}@{entry.joint}: {before:g} kg·m² before the spring would leave"
                f" {link[j, column]:g} kg·m² behind it. Give another motor_inertia_kgm2."
            )
    return rotors, link


def _shafts(present: Present, rotors: Floats, first: int) -> Shafts:
    """Elasticity and backlash of one axis are springs in series."""
    robot = present.robot
    J, C = robot.joints, robot.coupling_matrix()
    motors = sorted({present.joint(e) for key in _TRANSMISSIONS for e in present.of(key)})
    E = len(motors)
    twist = np.zeros((E, first + J + E))
    of_motor = np.full(J, -1, dtype=np.int64)
    for e, j in enumerate(motors):
        twist[e, first : first + J] = -C[j]
        twist[e, first + J + e] = 1.0
        of_motor[j] = e
    soft = [1 / present.by_joint(key, "stiffness_Nm_rad", np.inf)[motors] for key in _TRANSMISSIONS]
    damping = [present.by_joint(key, "damping_Nms_rad")[motors] for key in _TRANSMISSIONS]
    return Shafts(
        motor=np.array(motors, dtype=np.int64),
        rotor=np.arange(first + J, first + J + E, dtype=np.int64),
        twist=twist,
        inertia=rotors[motors],
        stiffness=1 / np.sum(soft, axis=0),
        cubic=present.by_joint("transmission.elasticity", "cubic_Nm_rad3")[motors],
        damping=np.sum(damping, axis=0),
        gap=present.by_joint("transmission.backlash", "gap_rad")[motors],
        of_motor=of_motor,
    )


def _rotor(present: Present, shafts: Shafts) -> Floats:
    robot = present.robot
    C = robot.coupling_matrix()
    own = np.array([joint.parameters.rotor_inertia_kgm2 for joint in robot.joint])
    own[shafts.motor] = 0.0
    rotor = C.T @ np.diag(own) @ C
    for entry in present.of("transmission.coupling"):
        row = _shared(present, entry)
        rotor += entry.parameters["inertia_kgm2"] * np.outer(row, row)
    return np.ascontiguousarray(rotor)


def _shared(present: Present, entry: EffectEntry) -> Floats:
    """Speed of parts that turn with two joints, over the joints, shape (J,)."""
    j = present.joint(entry)
    other = round(entry.parameters["other"]) or j
    row = np.zeros(present.robot.joints)
    row[j] = 1.0
    row[other - 1] = entry.parameters["ratio"]
    return row


def _rows(present: Present, body: Body, shafts: Shafts, first: int, h: float) -> tuple[Rows, Ints]:
    """Rows of friction: of each joint, of each motor that does not turn with one joint alone, of shared parts.

    A joint's row moves to its motor where a shaft is between them: the friction of bearings and gears is before the
    spring.
    """
    robot = present.robot
    J, n = robot.joints, first + robot.joints + len(shafts.motor)
    shared = present.of("transmission.coupling")
    K = len(body.dry_Nm) + len(shared)
    B, joint = np.zeros((K, n)), np.zeros(K, dtype=np.int64)
    coulomb, viscous = np.zeros(K), np.zeros(K)
    own = [j.parameters for j in robot.joint]
    coulomb[: len(body.dry_Nm)] = body.dry_Nm
    B[: len(body.dry_Nm), first : first + J] = body.dry_rows
    joint[:J] = np.arange(J)
    viscous[:J] = [p.viscous_Nms_rad for p in own]
    for m in range(J):
        k = body.brake_row[m]
        joint[k] = m
        viscous[k] += own[m].motor_viscous_Nms_rad
        if shafts.of_motor[m] >= 0:
            B[k] = 0.0
            B[k, shafts.rotor[shafts.of_motor[m]]] = 1.0
    for k, entry in enumerate(shared, len(body.dry_Nm)):
        B[k, first : first + J] = _shared(present, entry)
        joint[k] = present.joint(entry)
        coulomb[k], viscous[k] = entry.parameters["coulomb_Nm"], entry.parameters["viscous_Nms_rad"]

    def of(effect: str, name: str, absent: float = 0.0) -> Floats:
        """On the rows of the joints themselves."""
        return np.concatenate([present.by_joint(effect, name, absent), np.full(K - J, absent)])

    lag_s = of("friction.stribeck", "lag_s")
    # Temperature is that of a joint's lubricant, which motor and shared parts run in as well.
    per_K = {name: present.by_joint("friction.temperature", name)[joint] for name in ("viscous_per_K", "coulomb_per_K")}
    driving, braking = (of("transmission.efficiency", name, 1.0) for name in ("driving", "braking"))
    distance = of("friction.presliding", "distance_rad")
    stiction = of("friction.stribeck", "stiction_Nm")
    limit, slide_at = bristles()
    rows = Rows(
        B=B,
        joint=joint,
        coulomb=coulomb,
        viscous=viscous,
        stiction=stiction,
        stribeck=of("friction.stribeck", "velocity_rad_s", 1.0),
        exponent=of("friction.stribeck", "exponent", 1.0),
        lag=1 - np.exp(-h / np.maximum(lag_s, 1e-12)),
        asymmetry=of("friction.asymmetric", "half_difference_Nm"),
        curve=of("friction.viscous_nonlinear", "torque_Nm"),
        curve_speed=of("friction.viscous_nonlinear", "velocity_rad_s", 1.0),
        curve_power=of("friction.viscous_nonlinear", "exponent", 1.0),
        load=of("friction.load", "coefficient"),
        preload=of("friction.load", "preload_Nm"),
        driving=1 / driving - 1,
        braking=1 - braking,
        distance=np.where(coulomb + stiction > 0, distance, 0.0),
        bristle_damping=of("friction.presliding", "damping_Nms_rad"),
        limit=limit,
        slide_at=slide_at,
        viscous_per_K=per_K["viscous_per_K"],
        coulomb_per_K=per_K["coulomb_per_K"],
        reference_C=present.by_joint("friction.temperature", "reference_C")[joint],
        spot_row=present.joints("friction.position"),
        spot=present.listed("friction.position", "amplitude_Nm"),
        spot_centre=present.listed("friction.position", "centre_rad"),
        spot_width=present.listed("friction.position", "width_rad"),
    )
    return rows, body.brake_row


def _motors(present: Present) -> Motors:
    robot = present.robot
    loss = present.by_joint("motor.saturation", "loss")
    at_A = present.by_joint("motor.saturation", "current_A", 1.0)
    ripple = present.joints("motor.ripple")
    gear = np.array([joint.drive.gear_ratio for joint in robot.joint])

    def of(name: str) -> Floats:
        return present.listed("motor.ripple", name)

    return Motors(
        knee_A=np.array([knee_of(x, a) if x > 0 else 0.0 for x, a in zip(loss, at_A, strict=True)]),
        motor=ripple,
        per_rad=of("order") * gear[ripple],
        amplitude=of("amplitude_Nm"),
        phase=of("phase_rad"),
        second=of("second_Nm"),
        second_phase=of("second_phase_rad"),
        per_A=of("per_current_Nm_A"),
    )


def _sensing(present: Present, h: float) -> Sensing:
    robot = present.robot
    filter_s = present.by_joint("drive.delay", "filter_s")
    per_rad = present.by_joint("sensor.eccentricity", "order", 1.0) * np.array(
        [joint.drive.gear_ratio for joint in robot.joint]
    )
    disc = present.by_joint("sensor.eccentricity", "amplitude_rad") * per_rad
    for j in np.flatnonzero(np.abs(disc) >= 0.5):
        raise ConfigError(
            f"{robot.name}: sensor.eccentricity@{robot.joint_names[j]}: amplitude_rad must be below"
            f" {0.5 / abs(per_rad[j]):.3g} rad at this order; a disc half its radius off its axis cannot be read."
        )
    return Sensing(
        offset_A=present.by_joint("drive.current_offset", "offset_A"),
        delay=present.by_joint("drive.delay", "delay_s") / h,
        smoothing=h / (h + filter_s),  # a pole whose delay is filter_s, sampled as it is
        disc=disc,
        disc_per_rad=per_rad,
        disc_phase=present.by_joint("sensor.eccentricity", "phase_rad"),
    )


def _environment(present: Present) -> Environment:
    appears = present.listed("contact", "start_s")
    return Environment(
        spring=present.joints("spring"),
        stiffness=present.listed("spring", "stiffness_Nm_rad"),
        centre=present.listed("spring", "centre_rad"),
        cubic=present.listed("spring", "cubic_Nm_rad3"),
        progressive=present.listed("spring", "progressive_rad"),
        obstacle=present.joints("contact"),
        appears_s=appears,
        leaves_s=appears + present.listed("contact", "duration_s"),
        hardness=present.listed("contact", "stiffness_Nm_rad"),
        yields_Nm=present.listed("contact", "limit_Nm"),
        hum=present.joints("disturbance.periodic"),
        amplitude=present.listed("disturbance.periodic", "amplitude_Nm"),
        rad_s=2 * np.pi * present.listed("disturbance.periodic", "frequency_Hz"),
        phase=present.listed("disturbance.periodic", "phase_rad"),
    )


def _thermal(present: Present, period_s: float) -> Thermal:
    time_s = present.by_joint("friction.temperature", "time_constant_s", np.inf)
    lag_s = present.by_joint("friction.temperature", "sensor_lag_s")
    return Thermal(
        warming=period_s / time_s,
        rise_K_W=present.by_joint("friction.temperature", "rise_K_W"),
        sensing=1 - np.exp(-period_s / np.maximum(lag_s, 1e-12)),
    )


def _unlisted(present: Present, robot: Robot) -> Unlisted:
    def whole(name: str) -> Iterable[int]:
        return (round(x) for x in present.listed("unlisted", name))

    joint = present.joints("unlisted")
    speeds = np.array([j.velocity_max_rad_s for j in robot.joint])
    return Unlisted(
        form=np.array(list(whole("form")), dtype=np.int64),
        joint=joint,
        other=np.array(list(whole("other")), dtype=np.int64),
        a=present.listed("unlisted", "a"),
        b=present.listed("unlisted", "b"),
        speed=speeds[joint],
    )
