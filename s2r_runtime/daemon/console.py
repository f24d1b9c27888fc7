"""The daemon's console: one line an event, in plain words. What no person needs at once (chain heads, digests) stays in the log.

Lines that repeat (a gate that opens and closes with a shaky link) are printed once in `REPEAT_NS`, with how often it happened since.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from s2r_runtime import messages as m
from s2r_runtime.core import ledger
from s2r_runtime.core.reasons import in_words
from s2r_runtime.core.state import State

REPEAT_NS = 10_000_000_000
REMEMBERED = 200
"""Different lines whose repetitions are counted, the newest."""
LINES_A_CAMPAIGN = 20
"""A long campaign says less often how far it is than every ten samples."""
GROWN = 1.1
"""A smaller growth of the radius has no line of its own, unless it leaves what was verified."""


class Console:
    """say: prints a line. Every method is called in the order of the log."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._printed: dict[str, tuple[int, int]] = {}
        self._link: bool | None = None
        self._radius = 0.0
        self._n = 0
        self._unasked = 0

    def happened(self, event: m.Event) -> None:
        """An event comes."""
        match event:
            case m.LinkChanged(up=up) if up != self._link:
                self._link = up
                self._line(event.t_ns, "the robot is heard" if up else f"the robot is not heard any more{_why(event.detail)}")
            case m.OverrideChanged(kind=kind):
                self._line(event.t_ns, f"{kind.replace('_', ' ')} by the robot{_why(event.detail)}")
            case m.AnalyticsChanged(up=up):
                self._line(event.t_ns, f"the process that measures the gap is {'up again' if up else 'down'}{_why(event.detail)}")
            case m.SampleTaken(again=False, index=index) if (index + 1) % self._step() == 0 or index + 1 == self._n:
                self._line(event.t_ns, f"sample {index + 1} of {self._n}")
            case m.Requested():
                self._unasked = event.request_id if event.verb == "pause" and event.count else self._unasked
                self._line(event.t_ns, f"user {event.by}: {_request(event)}", always=True)
            case m.SourceStopped(source="controller", reason=reason) if reason not in ("finished", "stopped"):
                self._line(event.t_ns, f"the controller ended: {reason}{_why(event.detail)}")
            case m.EpisodeEnded(index=index, safety=safety) if safety < 0.0 or index in (0, 9) or index % 100 == 99:
                unsafe = ", UNSAFE" if safety < 0.0 else ""
                self._line(event.t_ns, f"scenario {index + 1} driven: safety value {safety:+.3g}{unsafe}")
            case _:
                pass

    def decided(self, outputs: Sequence[m.Output], state: State) -> None:
        """What came of it. state: after it."""
        answered = any(isinstance(output, m.Answer) for output in outputs)
        for output in outputs:
            if answered and isinstance(output, m.TraceEnded | m.ModelAdopted):
                continue  # the answer says it
            if text := self._text(output, state):
                self._line(output.t_ns, text, always=isinstance(output, m.Answer | m.AlarmRaised))

    def _text(self, output: m.Output, state: State) -> str:
        match output:
            case m.StartCampaign():
                self._n = output.n
                return campaign_line(output, state)
            case m.StartInputs(n=n):
                return f"given inputs are driven: {n} rows"
            case m.GateChanged(open=True):
                return "gate open: the controller drives"
            case m.GateChanged(reason=reason, detail=detail):
                return f"gate closed: {in_words(reason)}{_why(detail)}"
            case m.EpochChanged(gap=m.Gap() as gap):
                self._radius = gap.radius
                return ""
            case m.AttemptSpent(attempt=attempt, radius=radius, beta=beta):
                return f"verification attempt {attempt} begins, at radius {radius:.3g}; it spends {beta:.2g} of beta"
            case m.CertificateInstalled(facts=facts):
                return f"certificate {facts.id}: verified to radius {facts.verified_radius:.3g}"
            case m.Revoked(certificate_id=identity, reason=reason):
                return f"certificate {identity} revoked: {reason.replace('_', ' ')}"
            case m.EpisodeCounted(outcome=outcome, reason=reason, limits=limits) if outcome in ("unsafe", "censored"):
                return f"run {limits[0].n} of this controller counts as {outcome}: {reason}"
            case m.RadiusGrew(radius=radius, verified_radius=verified) if radius > self._radius * GROWN or 0.0 < verified < radius:
                self._radius = radius
                return f"the gap grew to {radius:.3g}" + (f", above the verified {verified:.3g}" if 0.0 < verified < radius else "")
            case m.AlarmRaised(e_value=e_value, epoch=epoch):
                return f"ALARM: the watch refuted the gap of epoch {epoch} (e-value {e_value:.3g}); a fresh campaign is due: s2r sample"
            case m.ChangeNoticed(kind="change"):
                return "notice: the robot has probably changed, the gap is exceeded more often than before"
            case m.ChangeNoticed():
                return "notice: the discrepancies of this drive are not of one distribution"
            case m.TraceEnded(stretch=stretch, verdict=verdict, reason=reason, proposal=proposal):
                return f"trace of the {stretch}: {verdict or reason}" + ("; a model is proposed: s2r adopt" if proposal else "")
            case m.ModelAdopted(by=by):
                return f"model adopted by {'the profile' if by < 0 else f'user {by}'}; its gap is not known yet"
            case m.Answer(text=text, request_id=number):
                return "" if number == self._unasked else text
            case _:
                return ""

    def _step(self) -> int:
        """Samples between two lines: every ten, or a twentieth of a long campaign."""
        return max(10, self._n // LINES_A_CAMPAIGN)

    def _line(self, now_ns: int, text: str, *, always: bool = False) -> None:
        last_ns, more = self._printed.pop(text, (now_ns - REPEAT_NS, 0))
        if not always and now_ns - last_ns < REPEAT_NS:
            self._printed[text] = (last_ns, more + 1)
            return
        self._printed[text] = (now_ns, 0)
        while len(self._printed) > REMEMBERED:
            del self._printed[next(iter(self._printed))]
        self._say(f"{text} ({more} more times since)" if more else text)


def campaign_line(order: m.StartCampaign, state: State) -> str:
    """What begins, and what it costs."""
    if order.resume:
        return f"campaign of epoch {order.epoch} goes on: {order.n} samples"
    settings, memory = state.settings, state.memory
    beta = 0.0 if settings is None else settings.beta
    left = beta - ledger.spent(beta, memory.epochs, memory.attempts)
    return f"campaign of epoch {order.epoch} begins: {order.n} samples; it spends {order.beta:.2g} of beta {beta:g}, {left:.3g} is left"


def _why(detail: str) -> str:
    return f": {detail}" if detail else ""


def _request(event: m.Requested) -> str:
    """As the person typed it, near enough."""
    match event.verb:
        case "permit":
            return f"s2r permit {event.duration_s:g}"
        case "sample":
            return "s2r sample" + (f" -n {event.count}" if event.count else "") + (" --retry" if event.text == "retry" else "")
        case "excite":
            return "s2r sample --inputs"
        case "pause" if event.count:
            return f"the command is interrupted: {event.text}"
        case "pause" | "cancel":
            return f"s2r sample --{event.verb}"
        case "trace":
            return f"s2r trace --live {event.text or 'campaign'}"
        case verb:
            return f"s2r {verb} {event.text}".strip()
