"""`explain` on what was recorded from an emulated machine: names what is there, and nothing where nothing is.

Emulated form and hypothesis differ (bristles against a static curve). Seeds 301 to 304 are for this test alone.
"""

from pathlib import Path

import msgspec
import pytest

from daq.recorder import Recorder
from emulator.host import Host
from emulator.lockstep import lockstep
from emulator.machine import load_machine
from emulator.rig import EmulatedRig
from ident.explain.contract import from_json, to_json
from ident.explain.explain import Answer, explain
from ident.explain.printout import render
from ident.explain.recorded import runs
from protocols import config
from protocols.effectentries import parse_effect
from protocols.motion import Motion
from protocols.recording import Recording, read_recording
from protocols.rig import load_rig
from protocols.robot import Robot


def record(folder: Path, motion: str, seed: int, *effects: str) -> Recording:
    rig, robot = load_rig("emps-rig")
    added = [parse_effect(text) for text in effects]
    rig = msgspec.structs.replace(rig, emulated=msgspec.structs.replace(rig.emulated, seed=seed, effect=added))
    plan = config.read(config.locate(motion), Motion)
    path = folder / f"{motion}.mcap"
    recorder = Recorder(path, rig, robot, seed=seed)
    lockstep(
        EmulatedRig(rig, load_machine(rig, robot)),
        Host(rig, robot, plan),
        rig.sync_period_us * 1000,
        lambda t_ns, bus, frames: recorder.frames(rig.bus[bus].name, [(t_ns, f) for f in frames]),
    )
    recorder.close()
    return read_recording(path)


def explained(folder: Path, seed: int, *effects: str) -> Answer:
    seen, unseen = (record(folder, f"emps-{name}", seed, *effects) for name in ("train", "test"))
    return explain(runs([seen]), seen.robot, runs([unseen]))


def test_a_healthy_axis_lacks_nothing(tmp_path: Path) -> None:
    explanation = explained(tmp_path, 301).explanation
    assert explanation.verdict == "nothing-missing"
    assert not explanation.findings
    assert explanation.power, "silence is worth what the recording could have shown"


@pytest.mark.parametrize(("seed", "effect"), [(302, "friction.stribeck@carriage"), (303, "motor.ripple@carriage")])
def test_what_was_left_out_is_named_and_where(tmp_path: Path, seed: int, effect: str) -> None:
    answer = explained(tmp_path, seed, effect)
    key, _, joint = effect.partition("@")
    best = max(answer.explanation.findings, key=lambda f: f.gain_nats)
    assert (best.effect, best.joints) == (key, [joint])
    assert best.probability > 0.5
    unseen = answer.explanation.before_after.excess_ratio.unseen
    assert unseen is not None
    assert unseen[1] < unseen[0], "the fit improves on motion that the search has not seen"
    assert key in render(answer.explanation)
    assert from_json(to_json(answer.explanation)) == answer.explanation


def test_the_robot_file_with_its_findings_can_be_emulated(tmp_path: Path) -> None:
    answer = explained(tmp_path, 304, "friction.stribeck@carriage")
    again = config.parse(config.to_toml(answer.robot), Robot, "explained.toml")
    assert [(e.effect, e.joint) for e in again.effect] == [("friction.stribeck", "carriage")]
    path = tmp_path / "explained.toml"
    path.write_text(config.to_toml(again))
    rig, robot = load_rig("emps-rig")
    rig = msgspec.structs.replace(rig, emulated=msgspec.structs.replace(rig.emulated, machine=str(path)))
    assert EmulatedRig(rig, load_machine(rig, robot)).cycles == 0
