"""Counters that prove, or disprove, that no cyclic frame was lost, and the verdict drawn from them.

What is provable: a SYNC carries a counter (0x1019), a TPDO1 carries the drive's own count of SYNCs (0x2001). A frame
of these two kinds that is missing shows as a step of more than one. Other frames (RPDOs, SDO, EMCY) carry no counter;
of them only drops that the socket or our own queue report are known.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from protocols import topics


@dataclass(slots=True)
class BusCounters:
    """Frames of one bus since the run started.

    Attributes:
        frames: All that arrived.
        syncs: Distinct SYNCs; `lost` and `duplicated` by their counter.
        uncounted: SYNCs without a counter.
        malformed: SYNCs and TPDOs of a wrong length, ignored by the decoder.
        dropped: By the socket (SO_RXQ_OVFL) or by a full queue of ours.
    """

    frames: int = 0
    syncs: int = 0
    lost: int = 0
    duplicated: int = 0
    uncounted: int = 0
    malformed: int = 0
    dropped: int = 0


@dataclass(slots=True)
class DriveCounters:
    """Cyclic feedback (TPDO1) of one drive since the run started.

    Attributes:
        frames: Distinct ones.
        lost: By the drive's cycle counter, or absent while other drives reported.
        duplicated: The same counter again.
        uncounted: Without a cycle counter.
    """

    frames: int = 0
    lost: int = 0
    duplicated: int = 0
    uncounted: int = 0


@dataclass(frozen=True, slots=True)
class Verdict:
    """Judgement of a recording's completeness.

    Attributes:
        text: `LOSSLESS`, `GAPS(n)` with n missing frames, or `UNVERIFIABLE`.
        because: Reasons in the rig's words, none for LOSSLESS.
    """

    text: str
    because: tuple[str, ...] = ()


@dataclass(slots=True)
class Integrity:
    """All counters of a run.

    Attributes:
        bus, drive: By name of bus and joint.
        queue_high_water: Most frames that ever waited for the writer.
    """

    bus: dict[str, BusCounters]
    drive: dict[str, DriveCounters]
    queue_high_water: int = 0

    @classmethod
    def of(cls, buses: list[str], joints: list[str]) -> "Integrity":
        """Counters at zero."""
        return cls({b: BusCounters() for b in buses}, {j: DriveCounters() for j in joints})

    def verdict(self) -> Verdict:
        """GAPS before UNVERIFIABLE: one frame known to be lost settles the question."""
        by_counter = sum(b.lost for b in self.bus.values()) + sum(d.lost for d in self.drive.values())
        missing = max(by_counter, sum(b.dropped for b in self.bus.values()))  # drops show in the counters again
        if missing:
            gaps = [f"{name}: {b.lost} SYNC lost" for name, b in self.bus.items() if b.lost]
            gaps += [f"{name}: {b.dropped} frames dropped by the receiver" for name, b in self.bus.items() if b.dropped]
            gaps += [f"{joint}: {d.lost} TPDO1 lost" for joint, d in self.drive.items() if d.lost]
            return Verdict(f"GAPS({missing})", tuple(gaps))
        unproven = [f"{n}: {b.uncounted} SYNCs without counter" for n, b in self.bus.items() if b.uncounted]
        unproven += [f"{n}: no SYNC seen" for n, b in self.bus.items() if not b.syncs]
        unproven += [f"{j}: {d.uncounted} TPDO1 without cycle counter" for j, d in self.drive.items() if d.uncounted]
        unproven += [f"{j}: no TPDO1 seen" for j, d in self.drive.items() if not d.frames]
        return Verdict("UNVERIFIABLE", tuple(unproven)) if unproven else Verdict("LOSSLESS")

    def message(self, t_ns: int) -> Mapping[str, Any]:
        """Fields of an `armrig_msgs/msg/Integrity`."""
        buses, drives = list(self.bus.values()), list(self.drive.values())
        return {
            **topics.stamp(t_ns),
            "header.frame_id": "",
            "verdict": self.verdict().text,
            "bus": list(self.bus),
            "frames": [b.frames for b in buses],
            "syncs": [b.syncs for b in buses],
            "syncs_lost": [b.lost for b in buses],
            "syncs_duplicated": [b.duplicated for b in buses],
            "joint": list(self.drive),
            "feedback": [d.frames for d in drives],
            "feedback_lost": [d.lost for d in drives],
            "feedback_duplicated": [d.duplicated for d in drives],
            "malformed": sum(b.malformed for b in buses),
            "dropped": sum(b.dropped for b in buses),
            "queue_high_water": self.queue_high_water,
        }
