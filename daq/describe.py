"""`armrig info`: what a recording holds, from its summary records, its events and its counters."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocols import topics
from protocols.container import BrokenFileError, Contents, scan
from protocols.errors import DataError
from protocols.gather import arrivals, messages
from protocols.recording import damage, map_file, verdict

_NS = 1e-9


def describe(path: Path) -> dict[str, Any]:
    """JSON-able description of a recording.

    Raises:
        DataError: Unreadable, truncated or damaged.
    """
    label = str(path)
    buffer = map_file(path, label)
    try:
        contents = scan(buffer)
        times = arrivals(contents)
        found = messages(contents, [topics.EVENTS, topics.COUNTERS])
        events = [topics.EVENT.decode(row.tobytes()) for block in found[topics.EVENTS].blocks for row in block]
        counters = [block[-1].tobytes() for block in found[topics.COUNTERS].blocks if len(block)]
        integrity = topics.INTEGRITY.decode(counters[-1]) if counters else {}
    except BrokenFileError as error:
        raise damage(label, error) from error
    except (ValueError, KeyError) as error:
        raise DataError(f"{label} does not follow its own message types: {error}.") from error
    every = [t for t in times.values() if len(t)]
    first, last = (min(int(t.min()) for t in every), max(int(t.max()) for t in every)) if every else (0, 0)
    start = topics.RunStart.of_metadata(contents.metadata.get(topics.RUN_START, {}))
    stop = contents.metadata.get(topics.RECOVERED) or contents.metadata.get(topics.RUN_STOP) or {}
    return {
        "file": label,
        "bytes": len(buffer),
        "seconds": (last - first) * _NS,
        "cycles": len(times.get(topics.CYCLE, ())),
        "verdict": verdict(contents),
        "because": [reason for reason in stop.get("because", "").split("; ") if reason],
        "recovered": topics.RECOVERED in contents.metadata,
        "robot": start.robot,
        "rig": start.rig,
        "joints": start.joints.split(),
        "sync_period_us": int(start.sync_period_us) if start.sync_period_us.isdecimal() else None,
        "seed": int(start.seed) if start.seed.isdecimal() else None,
        "created_utc": start.created_utc,
        "versions": {"armrig": start.armrig, "python": start.python, "library": contents.header.library},
        "sha256": start.sha256,
        "attachments": {name: len(data) for name, data in contents.attachments.items()},
        "topics": {topic: _topic(contents, topic, log_time) for topic, log_time in sorted(times.items())},
        "integrity": {k: v for k, v in integrity.items() if not k.startswith("header.") and k != "verdict"},
        "events": [
            {
                "t_s": e["stamp.sec"] + e["stamp.nanosec"] * _NS,
                "level": topics.LEVELS.get(e["level"], str(e["level"])),
                "source": e["name"],
                "text": e["msg"],
            }
            for e in events
        ],
    }


def _topic(contents: Contents, topic: str, log_time: NDArray[np.uint64]) -> dict[str, Any]:
    channel = next(c for c in contents.channels.values() if c.topic == topic)
    schema = contents.schemas.get(channel.schema_id)
    span_s = float(log_time.max() - log_time.min()) * _NS if len(log_time) else 0.0
    return {
        "type": schema.name if schema else "",
        "messages": len(log_time),
        "rate_Hz": (len(log_time) - 1) / span_s if span_s > 0 else None,
    }


def text(found: dict[str, Any]) -> str:
    """The description for people."""
    made = [
        found["created_utc"],
        f"armrig {found['versions']['armrig']}" if found["versions"]["armrig"] else "",
        "" if found["seed"] is None else f"seed {found['seed']}",
        "recovered" if found["recovered"] else "",
    ]
    lines = [
        f"{found['file']}: {found['seconds']:.3f} s, {found['cycles']} cycles, {found['bytes'] / 1e6:.1f} MB,"
        f" {found['verdict']}",
        *(f"  {reason}" for reason in found["because"]),
        f"robot {found['robot'] or 'unknown'}, rig {found['rig'] or 'unknown'}, joints {' '.join(found['joints'])}",
        ", ".join(part for part in made if part),
    ]
    for name, topic in found["topics"].items():
        rate = "" if topic["rate_Hz"] is None else f"{topic['rate_Hz']:10.1f} Hz"
        lines.append(f"  {name:20} {topic['messages']:9} {rate:13} {topic['type']}")
    lines += [f"  {e['t_s']:10.3f} s  {e['level']:7} {e['source']}: {e['text']}" for e in found["events"]]
    return "\n".join(lines)
