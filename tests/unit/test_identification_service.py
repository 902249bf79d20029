"""The service without Zenoh: request bytes in, reply bytes out."""

from collections.abc import Callable
from html.parser import HTMLParser

import msgspec
import pytest

from ident.contract import from_json
from ident.dataset import Signals
from ident.service import RefusedError, Service
from ident.zenoh_client import Answer, collect
from protocols import config, messages
from protocols.errors import ConfigError, DataError, IdentificationError, PeerError
from protocols.robot import Robot

Make = Callable[..., Signals]


@pytest.fixture(scope="module")
def files(tx40: Robot, make_signals: Make, make_recording: Callable[[Robot, Signals], bytes]) -> dict[str, bytes]:
    return {
        f"run-{seed}": make_recording(tx40, make_signals(tx40, seed, 8.0, noise_Nm=0.3, delay_s=0.0005))
        for seed in (1, 2)
    }


def attached(name: str, data: bytes) -> messages.Attached:
    return messages.Attached(name=f"{name}.mcap", bytes=len(data), sha256=messages.sha256(data))


def ask(files: dict[str, bytes], payload: bytes, method: str = "wls") -> list[bytes]:
    service = Service(files.__getitem__, "0.0")
    job = service.accept(method, payload)
    replies = [service.accepted(job)]
    service.work(job, replies.append)
    return replies


def answer(replies: list[bytes]) -> Answer:
    return collect(replies, lambda fraction, stage: None)


def test_attached_and_logged_recordings_give_result_report_and_model(files: dict[str, bytes], tx40: Robot) -> None:
    request = messages.IdentifyRequest(
        id="r",
        methods=["wls", "ols"],
        runs=[attached("run-1", files["run-1"])],
        validation=[messages.Logged(log="run-2")],
        model=True,
    )
    replies = ask(files, messages.encode(request, files["run-1"]))
    assert isinstance(messages.decode_reply(replies[0])[0], messages.Accepted)
    assert isinstance(messages.decode_reply(replies[-1])[0], messages.Done)
    fractions = [r.fraction for r, _ in map(messages.decode_reply, replies) if isinstance(r, messages.Progress)]
    assert fractions == sorted(fractions)
    parts = answer(replies).parts
    wls, ols = from_json(parts["result"])
    assert (wls.method, ols.method) == ("IDIM-WLS", "IDIM-OLS")
    assert wls.runs == ["run-1.mcap"]
    assert wls.validation is not None and wls.validation.relative_error_percent < 3
    assert [r.verdict for r in wls.recordings] == ["LOSSLESS", "LOSSLESS"]
    assert wls.recordings[0].sha256 == messages.sha256(files["run-1"])
    found = config.parse(parts["model"].decode(), Robot, "model")
    assert found.joint[0].parameters.viscous_Nms_rad == pytest.approx(tx40.joint[0].parameters.viscous_Nms_rad, abs=0.2)
    assert parts["html"].startswith(b"<!doctype html>")


class _Outside(HTMLParser):
    """Collects what a browser would load from elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [v for k, v in attrs if k in ("src", "href", "xlink:href") and v and not v.startswith("#")]
        if tag in ("script", "link", "iframe"):
            self.found.append(tag)


def test_the_report_needs_nothing_from_outside_and_shows_the_truth_it_is_told(files: dict[str, bytes]) -> None:
    request = messages.IdentifyRequest(
        id="r", methods=["wls"], runs=[messages.Logged(log="run-1")], truth={"Fv1": 6.0, "Ia3": 99.0}
    )
    parts = answer(ask(files, messages.encode(request))).parts
    html = parts["html"].decode()
    outside = _Outside()
    outside.feed(html)
    assert outside.found == []
    assert "LOSSLESS" in html and "ZZ1R = ZZ1" in html and "How to read this" in html
    (result,) = from_json(parts["result"])
    truth = {p.name: p.truth for p in result.parameters if p.truth is not None}
    assert truth == {"Fv1": 6.0, "Ia3": 99.0}
    assert html.count('class="far"') == 1  # Ia3 alone is far from what was claimed
    assert result.fit.noise_floor_percent is None  # not all of the truth was told


def test_the_keys_of_the_contract(files: dict[str, bytes]) -> None:
    request = messages.IdentifyRequest(id="r", methods=["wls"], runs=[messages.Logged(log="run-1")], html=False)
    parts = answer(ask(files, messages.encode(request))).parts
    assert list(parts) == ["result"]
    value = msgspec.json.decode(parts["result"])
    promised = (
        "method robot runs parameters fit validation simulation statistics iterations converged condition_number"
        " physically_consistent seconds notes"
    )
    assert set(promised.split()) <= set(value)
    assert value["validation"] is None
    assert set(value["parameters"][0]) >= set("name value std rel_std_percent unit essential prior".split())  # noqa: SIM905
    assert set(value["fit"]) >= {"relative_error_percent", "per_joint_percent", "bandwidth_Hz", "rows"}
    for statistic in value["statistics"]:
        assert set(statistic) >= {"name", "null", "verdict"}
        assert ("p_value" in statistic) != ("not_applicable" in statistic)


@pytest.mark.parametrize(
    ("payload", "code", "sentence"),
    [
        (b"", "bad-request", "The message is empty"),
        (b"{", "bad-request", "not valid"),
        (b'{"id":"r","methods":["wls"],"runs":[{"source":"log","log":"a"}],"truth":{"Fv1":NaN}}', "bad-request", "NaN"),
        (b'{"id":"r","methods":["ols"],"runs":[{"source":"log","log":"a"}]}', "bad-request", "armrig/identify/ols"),
        (b'{"id":"r","methods":"wls","runs":[]}', "bad-request", "$.methods"),
        (b" " * (messages.MAX_PAYLOAD_BYTES + 1), "too-large", "at most 64 MiB"),
    ],
)
def test_a_bad_request_is_refused_before_any_work(payload: bytes, code: str, sentence: str) -> None:
    with pytest.raises(RefusedError) as error:
        Service(lambda log: b"", "0.0").accept("wls", payload)
    assert error.value.code == code
    if sentence != "NaN":
        assert sentence in str(error.value)


def failed(files: dict[str, bytes], **changes: object) -> list[bytes]:
    request = messages.IdentifyRequest(id="r", methods=["wls"], runs=[messages.Logged(log="run-1")], html=False)
    return ask(files, messages.encode(msgspec.structs.replace(request, **changes)))


@pytest.mark.parametrize(
    ("changes", "kind", "sentence"),
    [
        ({"robot_toml": "name = 3"}, ConfigError, "robot file of the request"),
        ({"runs": [messages.Logged(log="broken")]}, DataError, "broken"),
        ({"options": messages.Options(filter_Hz=499.0)}, ConfigError, "filter_Hz = 499 does not fit run-1"),
        ({"options": messages.Options(speed_threshold_rad_s=100.0)}, IdentificationError, "does not show"),
        ({"runs": [messages.Attached(name="x", bytes=1, sha256="0" * 64)]}, ConfigError, "announces 1 bytes"),
    ],
)
def test_a_failure_keeps_its_kind_and_ends_with_done(
    files: dict[str, bytes], changes: dict[str, object], kind: type[Exception], sentence: str
) -> None:
    replies = failed({**files, "broken": files["run-1"][:5000]}, **changes)
    last, _ = messages.decode_reply(replies[-1])
    assert isinstance(last, messages.Done) and last.status == "failed"
    with pytest.raises(kind) as error:
        answer(replies)
    assert sentence in str(error.value)


def test_an_answer_that_breaks_off_or_is_damaged_is_no_answer(files: dict[str, bytes]) -> None:
    request = messages.IdentifyRequest(id="r", methods=["wls"], runs=[messages.Logged(log="run-1")], html=False)
    replies = ask(files, messages.encode(request))
    with pytest.raises(PeerError, match="broke off after 1 parts"):
        answer(replies[:-1])
    with pytest.raises(PeerError, match="broke off after 0 parts"):
        answer([])
    flipped = replies[-2][:-3] + bytes([replies[-2][-3] ^ 1]) + replies[-2][-2:]
    with pytest.raises(PeerError, match="arrived damaged"):
        answer([*replies[:-2], flipped, replies[-1]])
    with pytest.raises(PeerError, match="arrived damaged: 0 parts"):
        answer([*replies[:-2], replies[-1]])
