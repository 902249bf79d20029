"""The identification service without its transport: request bytes in, reply bytes out."""

from collections.abc import Callable
from dataclasses import dataclass, field

from ident.contract import to_json
from ident.identify import DEFAULTS, Identification, Settings, identify
from ident.recorded import signals
from ident.report import render
from ident.writeback import identified_robot
from protocols import config, messages
from protocols.errors import ArmrigError, ConfigError
from protocols.recording import Recording, read_recording
from protocols.robot import Robot

Send = Callable[[bytes], None]


class RefusedError(ConfigError):
    """A request that is not started.

    Attributes:
        code: For the reply.
    """

    def __init__(self, code: messages.ErrorCode, message: str) -> None:
        super().__init__(message)
        self.code: messages.ErrorCode = code


@dataclass(frozen=True)
class Job:
    """An accepted request with the raw bytes that followed it."""

    request: messages.IdentifyRequest
    body: bytes


@dataclass
class _Outgoing:
    """Sends chunks and keeps the totals that `Done` must state."""

    send: Send
    count: int = 0
    sent: bytearray = field(default_factory=bytearray)

    def part(self, name: messages.Part, data: bytes) -> None:
        for start in range(0, len(data), messages.CHUNK_BYTES):
            piece = data[start : start + messages.CHUNK_BYTES]
            self.send(messages.encode(messages.Chunk(index=self.count, part=name, bytes=len(piece)), piece))
            self.count += 1
            self.sent += piece

    def done(self, status: messages.Status) -> None:
        self.send(messages.encode(messages.done(status, self.count, bytes(self.sent))))


class Service:
    """Answers requests; holds no state between them."""

    def __init__(self, fetch: Callable[[str], bytes], version: str) -> None:
        """
        Args:
            fetch: Bytes of a log by its key.
        """
        self._fetch = fetch
        self._version = version

    def accept(self, method: str, payload: bytes) -> Job:
        """Check a request; quick, the recordings are not looked at yet.

        Raises:
            RefusedError: Too large, malformed, or sent to the wrong key.
        """
        if len(payload) > messages.MAX_PAYLOAD_BYTES:
            raise RefusedError(
                "too-large",
                f"The request has {len(payload) / 2**20:.0f} MiB; at most {messages.MAX_PAYLOAD_BYTES >> 20} MiB are"
                " accepted. Name the recordings by log key instead.",
            )
        try:
            request, body = messages.decode(payload, messages.IdentifyRequest)
        except ConfigError as error:
            raise RefusedError("bad-request", str(error)) from error
        if method not in request.methods:
            raise RefusedError(
                "bad-request",
                f"The request for {', '.join(request.methods)} was sent to {messages.identify_key(method)};"
                f" send it to {messages.identify_key(request.methods[0])}.",
            )
        return Job(request, body)

    def accepted(self, job: Job) -> bytes:
        """The first reply."""
        return messages.encode(messages.Accepted(id=job.request.id, version=self._version))

    def work(self, job: Job, send: Send) -> None:
        """Do the job; what the user can mend is answered, not raised."""
        out = _Outgoing(send)
        try:
            for name, data in self._parts(job, send):
                out.part(name, data)
        except ArmrigError as error:
            send(messages.encode(messages.failure(error)))
            out.done("failed")
        else:
            out.done("ok")

    def _parts(self, job: Job, send: Send) -> list[tuple[messages.Part, bytes]]:
        """Parts of the result by name."""

        def progress(fraction: float, stage: str) -> None:
            send(messages.encode(messages.Progress(fraction=min(1.0, fraction), stage=stage)))

        request = job.request
        progress(0.0, "reading recordings")
        recordings = self._recordings(job)
        runs, validation = recordings[: len(request.runs)], recordings[len(request.runs) :]
        found = identify(
            [signals(r) for r in runs],
            runs[0].robot,
            request.methods,
            [signals(r) for r in validation],
            settings_of(request.options),
            request.truth,
            progress=lambda fraction, stage: progress(0.1 + 0.7 * fraction, stage),
        )
        parts: list[tuple[messages.Part, bytes]] = [("result", to_json([i.result for i in found]))]
        if request.html:
            progress(0.9, "report")
            parts.append(("html", render(found).encode()))
        if request.model:
            parts.append(("model", model_file(found[0]).encode()))
        return parts

    def _recordings(self, job: Job) -> list[Recording]:
        """Recordings of a request, runs first, each from the request's body or from the log server."""
        request = job.request
        robot = None
        if request.robot_toml is not None:
            robot = config.parse(request.robot_toml, Robot, "robot file of the request")
        named = [*request.runs, *request.validation]
        bodies = iter(messages.split([n for n in named if isinstance(n, messages.Attached)], job.body))
        out = []
        for recording in named:
            if isinstance(recording, messages.Attached):
                out.append(read_recording(next(bodies), robot, recording.name))
            else:
                out.append(read_recording(self._fetch(recording.log), robot, recording.log))
        return out


def settings_of(options: messages.Options) -> Settings:
    """Settings with the defaults where a request leaves them out."""

    def or_default(value: float | None, default: float) -> float:
        return default if value is None else value

    return Settings(
        filter_Hz=or_default(options.filter_Hz, DEFAULTS.filter_Hz),
        decimate_to_Hz=or_default(options.decimate_to_Hz, DEFAULTS.decimate_to_Hz),
        speed_threshold_rad_s=options.speed_threshold_rad_s,
        offsets=DEFAULTS.offsets if options.offsets is None else options.offsets,
    )


def model_file(identification: Identification) -> str:
    """TOML text of the identified robot."""
    return config.to_toml(identified_robot(identification.model, identification.base, identification.estimate.beta))
