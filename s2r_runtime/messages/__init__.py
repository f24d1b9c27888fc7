"""What flows through the runtime: frozen structs with stamps and units. SI and radians throughout.

Three families. *Frames* are what a transport received or sent, byte for byte (`link`). *Events* go into the core in the order in
which they are logged (`events`). *Outputs* come out of it: records (what was decided, and why) and actions (what the daemon is to
do; both in `outputs`). `results` and `memory` hold what events and outputs carry. `t_ns` is an integer on the daemon's monotonic
clock: the host's in real time, the robot's own in lockstep.

No field holds NaN or inf. What arrives non-finite is turned, at the edge, into a value with `fault` set and no numbers.

Everybody imports from here: `from s2r_runtime.messages import Observation`. The docstrings and the tags are in every log (its schemas).
"""

from s2r_runtime.messages.events import (
    AnalyticsChanged,
    AnswerLate,
    CampaignFinished,
    CertificateFailed,
    CertificatesDistrusted,
    CertificateStored,
    EpisodeEnded,
    EpisodeScored,
    Event,
    InputsFinished,
    JobFinished,
    LinkChanged,
    Measured,
    ObservationRefused,
    Observed,
    OverrideChanged,
    Proposed,
    RecorderChanged,
    Requested,
    SampleTaken,
    SeedDrawn,
    SourceStarted,
    SourceStopped,
    Started,
    Stopping,
    Ticked,
    WallClockRead,
)
from s2r_runtime.messages.link import (
    Command,
    Frame,
    LogHead,
    Observation,
    Source,
    Struct,
)
from s2r_runtime.messages.memory import (
    BEHAVIOURS,
    EPISODES,
    FIXED_SEEDS,
    GRID,
    IMPLAUSIBLE,
    LATEST_TIME,
    MEMORY_SCHEMA,
    REFUSED_FIRST,
    RESTARTS,
    RULES,
    SEEDS,
    UNKNOWN_PAST,
    Driven,
    Memory,
    OpenRun,
    Proposal,
    RefusedCampaign,
    RunCounts,
    Settings,
    Stretch,
    WatchStood,
)
from s2r_runtime.messages.outputs import (
    Action,
    AlarmRaised,
    Answer,
    Ask,
    AttemptEnded,
    AttemptSpent,
    CertificateInstalled,
    ChangeNoticed,
    Decided,
    DrawSeed,
    EpisodeCounted,
    EpochChanged,
    GateChanged,
    IssueCertificate,
    ModelAdopted,
    Output,
    Persist,
    RadiusGrew,
    Record,
    Revoked,
    Send,
    StartCampaign,
    StartController,
    StartInputs,
    StartJob,
    StopCampaign,
    StopController,
    TraceEnded,
)
from s2r_runtime.messages.results import (
    NOT_INDEPENDENT,
    REPEATED,
    SERIAL,
    CertificateFacts,
    Gap,
    LawResult,
    RadiusTried,
    RunLimits,
    Trials,
    Tries,
    Verification,
)

__all__ = [
    "BEHAVIOURS", "EPISODES", "FIXED_SEEDS", "GRID", "IMPLAUSIBLE", "LATEST_TIME", "MEMORY_SCHEMA", "NOT_INDEPENDENT", "REFUSED_FIRST",
    "REPEATED", "RESTARTS", "RULES", "SEEDS", "SERIAL", "UNKNOWN_PAST", "Action", "AlarmRaised", "AnalyticsChanged", "Answer", "AnswerLate",
    "Ask", "AttemptEnded", "AttemptSpent", "CampaignFinished", "CertificateFacts", "CertificateFailed", "CertificateInstalled",
    "CertificateStored", "CertificatesDistrusted", "ChangeNoticed", "Command", "Decided", "DrawSeed", "Driven", "EpisodeCounted",
    "EpisodeEnded", "EpisodeScored", "EpochChanged", "Event", "Frame", "Gap", "GateChanged", "InputsFinished", "IssueCertificate",
    "JobFinished", "LawResult", "LinkChanged", "LogHead", "Measured", "Memory", "ModelAdopted", "Observation", "ObservationRefused",
    "Observed", "OpenRun", "Output", "OverrideChanged", "Persist", "Proposal", "Proposed", "RadiusGrew", "RadiusTried", "Record",
    "RecorderChanged", "RefusedCampaign", "Requested", "Revoked", "RunCounts", "RunLimits", "SampleTaken", "SeedDrawn", "Send", "Settings",
    "Source", "SourceStarted", "SourceStopped", "StartCampaign", "StartController", "StartInputs", "StartJob", "Started", "StopCampaign",
    "StopController", "Stopping", "Stretch", "Struct", "Ticked", "TraceEnded", "Trials", "Tries", "Verification", "WallClockRead",
    "WatchStood",
]  # fmt: skip
