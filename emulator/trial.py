"""Cases of the blind trial: a machine nobody has seen, the session recorded of it, and the truth under seal.

The machine differs from its robot file by the errors that the file's 1-sigma admit, and by effects drawn from the
seed. `record` plays a session through every frame; `simulate` takes the short way past the bus, for development.
Development and scoring use seeds of their own: nothing may be tuned on the second.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np

from emulator import trialrun
from emulator.effects.unlisted import Form
from emulator.host import Host
from emulator.kernels import Floats
from emulator.lockstep import lockstep
from emulator.machine import load_machine
from emulator.plant import AMBIENT_C
from emulator.rig import EmulatedRig
from emulator.trialeffects import ALIKE, DRAWS, MOST_CHANGE, draw_effect, draw_unlisted, scaled
from emulator.trialmotions import Planned, once, session
from protocols.effectparams import EFFECT_KINDS
from protocols.effects import Effect
from protocols.errors import ConfigError
from protocols.frames import Frame
from protocols.motion import Motion
from protocols.rig import Rig, load_rig
from protocols.robot import EffectEntry, Joint, Parameters, Robot
from protocols.topics import CellSample

DEVELOPMENT_SEEDS = range(1, 100_000)
SCORING_SEEDS = range(1_000_000, 1_100_000)

Name = Literal["emps", "tx40"]
Kind = Literal["none", "single", "pair", "unlisted"]

SHARES: dict[Kind, float] = {"none": 0.25, "single": 0.45, "pair": 0.15, "unlisted": 0.15}
WEAKEST, STRONGEST = 0.3, 10.0  # strengths that are aimed at, evenly on a log scale
TRIES, CLOSE = 3, 0.75  # simulations in which a strength is aimed at, and how near is near enough
PLACES = 3  # where a weak effect is tried before it is left weak
PERIOD_S: dict[str, float] = {"emps": 8.0, "tx40": 6.0}
PAUSE_S = 420.0  # from the start of one recording to that of the next
SESSION_RISE_K, SESSION_WARMING_S = (8.0, 25.0), 900.0
# 1-sigma of the robot file's parameters, relative: a CAD model or an identification some time ago.
SIGMA = {
    "mass_kg": 0.03,
    "first_moment_kgm": 0.05,
    "inertia_kgm2": 0.06,
    "rotor_inertia_kgm2": 0.06,
    "viscous_Nms_rad": 0.15,
    "coulomb_Nm": 0.15,
    "motor_viscous_Nms_rad": 0.15,
    "motor_coulomb_Nm": 0.15,
    "offset_Nm": 0.2,
}
OFFSET_SIGMA = 0.02  # at least, of the Coulomb friction
SPREAD = 0.15  # by which each machine differs from the shipped one, relative

Frames = Callable[[str, Sequence[tuple[int, Frame]]], None]
Samples = Callable[[CellSample], None]


class Truth(msgspec.Struct, frozen=True, kw_only=True):
    """What is sealed.

    Attributes:
        kind: What was drawn.
        effects: With every number; `unlisted` ones name their form.
        strength: Of each effect: rms change of current over raw current noise, on the axis where it is largest.
        strongest: That axis, per effect.
        form: Of unlisted physics: what it is, in a word.
        contact_run: Recording in which an obstacle appears, from 0; -1 without one.
        machine: The robot file as it really is.
        nonce: Random, so that nobody finds the truth by hashing guesses.
    """

    seed: int
    rig: str
    kind: Kind
    effects: list[EffectEntry]
    strength: list[float]
    strongest: list[str]
    form: str
    contact_run: int
    machine: Robot
    nonce: str


class Seal(msgspec.Struct, frozen=True):
    """The truth as bytes, and the digest that is shown before anybody explains anything."""

    content: bytes
    sha256: str

    def open(self) -> Truth:
        """The truth, having checked that it is the one that was sealed.

        Raises:
            ConfigError: It is not.
        """
        found = hashlib.sha256(self.content).hexdigest()
        if found != self.sha256:
            raise ConfigError(
                f"the seal is broken: its content has the SHA-256 {found[:16]}..., but {self.sha256[:16]}... was"
                " announced. Draw the case again from its seed."
            )
        return msgspec.json.decode(self.content, type=Truth)


@dataclass(frozen=True)
class Run:
    """One recording of the session.

    Attributes:
        name: Of its file.
        plan: What the host is asked to do.
        period_s: One repetition.
        start_s: Since the start of the session.
        temperature_C: Motors and lubricants at its start.
        seed: Of its noise.
    """

    name: str
    plan: Motion
    period_s: float
    start_s: float
    temperature_C: float
    seed: int


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes:
        seed: Everything follows from it.
        rig: With the noise of this case; what a recorder attaches does not show it.
        robot: The robot file that the explainer gets: the machine as it is believed to be.
        runs: Three to learn from, and the unseen one last.
        seal: The truth.
    """

    seed: int
    rig: Rig
    robot: Robot
    runs: tuple[Run, ...]
    seal: Seal


def draw(seed: int, rig: Name = "emps", kind: Kind | None = None, effect: Effect | None = None) -> Case:
    """The case of a seed.

    Args:
        kind: What is hidden; drawn with `SHARES` where left out.
        effect: Of a single effect, which; drawn where left out.

    Raises:
        ConfigError: A seed of neither range.
    """
    if seed not in DEVELOPMENT_SEEDS and seed not in SCORING_SEEDS:
        raise ConfigError(
            f"seed {seed} is in no range: {DEVELOPMENT_SEEDS.start} to {DEVELOPMENT_SEEDS.stop - 1} are for"
            f" development, {SCORING_SEEDS.start} to {SCORING_SEEDS.stop - 1} for scoring."
        )
    rng = np.random.default_rng([seed, rig == "tx40"])
    shipped, nominal = load_rig(f"{rig}-rig")
    true = _machine(load_machine(shipped, nominal), rng)
    robot = _believed(nominal, true, rng)
    if kind is None:
        kind = "single" if effect else list(SHARES)[int(rng.choice(len(SHARES), p=list(SHARES.values())))]
    planned = session(robot, rng, PERIOD_S[rig])
    noise = tuple((np.array(shipped.emulated.current_noise_A) * rng.uniform(0.5, 1.5)).tolist())
    emulated = msgspec.structs.replace(shipped.emulated, machine=None, seed=seed, current_noise_A=noise)
    rig_file = msgspec.structs.replace(shipped, emulated=emulated)
    rise = rng.uniform(*SESSION_RISE_K)
    starts = PAUSE_S * np.arange(len(planned))
    runs = tuple(
        Run(
            name=p.motion.name,
            plan=p.motion,
            period_s=p.period_s,
            start_s=float(start),
            temperature_C=float(AMBIENT_C + rise * (1 - np.exp(-start / SESSION_WARMING_S))),
            seed=int(rng.integers(2**31)),
        )
        for p, start in zip(planned, starts, strict=True)
    )
    scene = _Scene(rig_file, robot, true, planned, AMBIENT_C + rise)
    hidden = [_hide(what, scene, rng) for what in _wanted(kind, effect, true, rng)]
    truth = Truth(
        seed=seed,
        rig=rig,
        kind=kind,
        effects=[h.entry for h in hidden],
        strength=[h.strength for h in hidden],
        strongest=[h.joint for h in hidden],
        form=next((Form(int(h.entry.parameters["form"])).name.lower() for h in hidden if h.is_unlisted), ""),
        contact_run=int(rng.integers(3)) if any(h.entry.effect == "contact" for h in hidden) else -1,
        machine=msgspec.structs.replace(true, effect=[h.entry for h in hidden]),
        nonce=rng.bytes(16).hex(),
    )
    content = msgspec.json.encode(truth)
    return Case(seed, rig_file, robot, runs, Seal(content, hashlib.sha256(content).hexdigest()))


def record(case: Case, run: Run, frames: Frames, cell: Samples) -> int:
    """Play one recording through every frame of the buses.

    Args:
        frames: Told of all that passes on a bus, by its name, pairs (t_ns, frame), as a recorder wants it.
        cell: Told of the cell's registers as often as a recorder would ask.

    Returns:
        Simulated time [ns].

    Raises:
        PeerError: As the host's script.
    """
    rig = msgspec.structs.replace(case.rig, emulated=msgspec.structs.replace(case.rig.emulated, seed=run.seed))
    emulated = EmulatedRig(rig, _machine_of(case, run))
    emulated.plant.warm_to(np.full(case.robot.joints, run.temperature_C))
    every_ns = round(1e9 / (rig.cell.poll_Hz if rig.cell else 20.0))
    polls = 0

    def tap(t_ns: int, bus: int, passed: Sequence[Frame]) -> None:
        nonlocal polls
        frames(rig.bus[bus].name, [(t_ns, frame) for frame in passed])
        if t_ns >= polls * every_ns:
            polls += 1
            state = emulated.cell()
            cell(
                CellSample(
                    t_ns=t_ns,
                    motor_temperature_C=state.motor_temperature_C,
                    ambient_temperature_C=state.ambient_temperature_C,
                    supply_V=state.supply_V,
                    emergency_stop=state.emergency_stop,
                    brake_released=state.brake_released,
                    heartbeat=polls,
                    sequence=polls,
                    stale=False,
                )
            )

    return lockstep(emulated, Host(rig, case.robot, run.plan), rig.sync_period_us * 1000, tap)


def simulate(case: Case, run: Run) -> trialrun.Signals:
    """The same motion under the same law, past the bus: start-up and SYNC counters are not there, the rest is."""
    machine = _machine_of(case, run)
    return trialrun.run(case.rig, case.robot, machine, run.plan, run.temperature_C, run.seed)


def _machine_of(case: Case, run: Run) -> Robot:
    """The machine during one recording: an obstacle appears in one of them only."""
    truth = case.seal.open()
    here = case.runs.index(run) == truth.contact_run
    effects = [entry for entry in truth.machine.effect if here or entry.effect != "contact"]
    return msgspec.structs.replace(truth.machine, effect=effects)


def _machine(shipped: Robot, rng: np.random.Generator) -> Robot:
    """Another machine of the same make: bodies scaled as a whole, so that each could still be built."""

    def differ(p: Parameters) -> Parameters:
        body, rotor, viscous, coulomb = np.exp(SPREAD * rng.uniform(-1, 1, 4)).tolist()
        return msgspec.structs.replace(
            p,
            mass_kg=p.mass_kg * body,
            first_moment_kgm=tuple(x * body for x in p.first_moment_kgm),
            inertia_kgm2=tuple(x * body for x in p.inertia_kgm2),
            rotor_inertia_kgm2=p.rotor_inertia_kgm2 * rotor,
            viscous_Nms_rad=p.viscous_Nms_rad * viscous,
            motor_viscous_Nms_rad=p.motor_viscous_Nms_rad * viscous,
            coulomb_Nm=p.coulomb_Nm * coulomb,
            motor_coulomb_Nm=p.motor_coulomb_Nm * coulomb,
        )

    joints = [msgspec.structs.replace(joint, parameters=differ(joint.parameters)) for joint in shipped.joint]
    return msgspec.structs.replace(shipped, joint=joints, effect=[])


def _believed(nominal: Robot, true: Robot, rng: np.random.Generator) -> Robot:
    """The robot file: true parameters with errors of the 1-sigma that it states."""

    def of(joint: Joint, truth: Parameters) -> Joint:
        value, sigma = {}, {}
        for name, relative in SIGMA.items():
            exact = np.atleast_1d(np.array(getattr(truth, name), dtype=float))
            spread = relative * np.full(exact.shape, np.abs(exact).max())
            if name == "inertia_kgm2":
                spread[[1, 2, 4]] /= 2  # products of inertia
            if name == "offset_Nm":
                spread = np.maximum(spread, OFFSET_SIGMA * truth.coulomb_Nm)
            drawn = exact + spread * np.clip(rng.normal(size=exact.shape), -2, 2)
            value[name] = drawn.tolist() if exact.size > 1 else float(drawn[0])
            sigma[name] = spread.tolist() if exact.size > 1 else float(spread[0])
        parameters, uncertain = (msgspec.convert(table, Parameters) for table in (value, sigma))
        return msgspec.structs.replace(joint, parameters=parameters, sigma=uncertain)

    joints = [of(joint, other.parameters) for joint, other in zip(nominal.joint, true.joint, strict=True)]
    return msgspec.structs.replace(nominal, joint=joints, effect=[])


@dataclass(frozen=True)
class _Scene:
    """Where effects are hidden; `celsius` is the temperature at the end of the session."""

    rig: Rig
    robot: Robot
    true: Robot
    planned: Sequence[Planned]
    celsius: float

    def current(self, effects: list[EffectEntry], seed: int) -> Floats:
        """Reported currents of one repetition of a fast and of the slow motion, shape (T, J) [A]."""
        machine = msgspec.structs.replace(self.true, effect=effects)
        looks = [once(self.planned[k]) for k in (0, 2)]
        runs = [trialrun.run(self.rig, self.robot, machine, plan, self.celsius, seed) for plan in looks]
        per_A = 1000 / np.array([joint.drive.rated_current_A for joint in self.robot.joint])
        return np.concatenate([run.current_permille / per_A for run in runs])


@dataclass(frozen=True)
class _Hidden:
    """An effect, its strength as measured, and the axis where it shows most."""

    entry: EffectEntry
    strength: float
    joint: str

    @property
    def is_unlisted(self) -> bool:
        return self.entry.effect == "unlisted"


def _wanted(kind: Kind, effect: Effect | None, robot: Robot, rng: np.random.Generator) -> list[Effect]:
    """Names of what is hidden."""
    if kind == "none":
        return []
    if kind == "unlisted":
        return ["unlisted"]
    names = [name for name in DRAWS if robot.joints >= EFFECT_KINDS[name].least_joints]
    first = effect or names[int(rng.integers(len(names)))]
    if kind == "single":
        return [first]
    alike = {first}.union(*(group for group in ALIKE if first in group))
    others = [name for name in names if name not in alike]
    return [first, others[int(rng.integers(len(others)))]]


def _hide(what: Effect, scene: _Scene, rng: np.random.Generator) -> _Hidden:
    """An effect with a strength near one that is drawn, somewhere on the arm where it can have it."""
    goal = float(np.exp(rng.uniform(np.log(WEAKEST), np.log(STRONGEST))))
    seed = int(rng.integers(2**31))
    plain = scene.current([], seed)
    best = None
    for _ in range(PLACES):
        entry = draw_unlisted(scene.true, rng) if what == "unlisted" else draw_effect(what, scene.true, rng)
        found = _aim(entry, goal, plain, scene, seed)
        if best is None or found.strength > best.strength:
            best = found
        if best.strength >= WEAKEST:
            break
    if best is None:
        raise ConfigError(f"{what} could be hidden nowhere.")
    return best


def _aim(entry: EffectEntry, goal: float, plain: Floats, scene: _Scene, seed: int) -> _Hidden:
    """The effect scaled until it is about as strong as wanted."""
    noise = np.array(scene.rig.emulated.current_noise_A)
    total = 1.0
    for attempt in range(1, TRIES + 1):
        each = np.sqrt(np.mean((scene.current([entry], seed) - plain) ** 2, axis=0)) / noise
        strength = float(each.max())
        factor = float(np.clip(goal / max(strength, 1e-6), 1 / MOST_CHANGE / total, MOST_CHANGE / total))
        if attempt == TRIES or CLOSE < factor < 1 / CLOSE:
            break
        total *= factor
        entry = scaled(entry, factor)
    return _Hidden(entry, strength, scene.robot.joint_names[int(np.argmax(each))])
