"""Verbs that run the daemon or talk to it: run, sample, deploy, undeploy, revoke, adopt, clear, stop, permit, status."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from s2r_runtime.cli import output
from s2r_runtime.cli.choices import count, positive
from s2r_runtime.cli.presence import Presence
from s2r_runtime.errors import UsageError


def add(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the verbs of this module."""
    run = verbs.add_parser("run")
    run.add_argument("profile", type=Path, metavar="PROFILE", help="the robot's profile (TOML)")
    run.add_argument(
        "--state", type=Path, metavar="DIR", help="where counters, certificates and logs live (default: the user's state folder, by robot)"
    )
    run.add_argument(
        "--key", type=Path, metavar="FILE", help="signing key (default: one of the robot's own in the state folder, made when first needed)"
    )
    run.add_argument("--log", type=Path, metavar="DIR", help="where logs go (default: as the profile says)")
    run.add_argument("--seed", type=count, help="seed of the campaigns and scenarios (default: the profile's)")
    run.set_defaults(run=run_daemon)

    sample = verbs.add_parser(
        "sample",
        epilog="Ctrl-C, a closed terminal, a dropped ssh or a killed command stop the robot and keep the campaign; the same command goes "
        "on with it. With --detach the campaign goes on by itself.",
    )
    sample.add_argument("profile", type=Path, metavar="PROFILE", help="the robot's profile (TOML)")
    sample.add_argument("-o", "--output", type=Path, metavar="FILE.mcap", help="the recording (without a running daemon)")
    sample.add_argument(
        "-n", type=count, default=0, metavar="N", help="samples, fixed beforehand (default: what the profile or its beta asks for)"
    )
    sample.add_argument(
        "--permit",
        type=positive,
        metavar="S",
        help="without a daemon: for how many seconds the robot may be driven (default 3600). Running this verb is the permit",
    )
    sample.add_argument(
        "--retry",
        action="store_true",
        help="if its samples turn out to depend on each other, which 1 in 200 good campaigns seem to, repeat it once; "
        "the repetition is the next epoch, and spends its share of beta",
    )
    end = sample.add_mutually_exclusive_group()
    end.add_argument("--detach", action="store_true", help="return when the daemon drives; the campaign goes on without this command")
    end.add_argument("--pause", action="store_true", help="stop the running daemon's campaign and keep it; s2r sample goes on with it")
    end.add_argument("--cancel", action="store_true", help="stop the running daemon's campaign and give it up; its share of beta is spent")
    sample.add_argument(
        "--inputs",
        type=Path,
        metavar="FILE.csv",
        help="drive these inputs instead, through the running daemon: for s2r trace --live inputs; no campaign, so no gap",
    )
    _common(sample)
    sample.set_defaults(run=run_sample)

    deploy = _talker(
        verbs,
        "deploy",
        "Ctrl-C before the controller drives withdraws it. Once it drives, it drives on without this command: s2r undeploy ends that.",
    )
    deploy.add_argument(
        "controller", type=Path, metavar="CONTROLLER", help="a Python file with control(x, theta, parameters), or a learned policy (.onnx)"
    )
    deploy.add_argument("--certificate", type=Path, metavar="CERT", help="a certificate made by s2r certify")
    deploy.add_argument("--param", action="append", default=[], metavar="K=V", help="a parameter of the controller; may be repeated")
    deploy.set_defaults(run=run_deploy)

    undeploy = _talker(verbs, "undeploy")
    undeploy.set_defaults(run=lambda a: _say(a, {"verb": "undeploy"}))

    revoke = _talker(verbs, "revoke")
    revoke.add_argument("certificate", metavar="ID", nargs="?", default="", help="certificate id (default: all)")
    revoke.set_defaults(run=lambda a: _say(a, {"verb": "revoke", "text": a.certificate}))

    adopt = _talker(verbs, "adopt")
    adopt.add_argument("model", type=Path, nargs="?", metavar="MODEL.toml", help="default: the model that tracing proposes (s2r status)")
    adopt.set_defaults(run=run_adopt)

    clear = _talker(verbs, "clear")
    clear.add_argument("reason", metavar="REASON", help="as s2r status names it, such as emergency_stop")
    clear.set_defaults(run=lambda a: _say(a, {"verb": "clear", "text": a.reason}))

    stop = _talker(verbs, "stop")
    stop.set_defaults(run=lambda a: _say(a, {"verb": "stop"}))

    permit = _talker(verbs, "permit")
    permit.add_argument("seconds", type=positive, metavar="SECONDS", help="from now on")
    permit.set_defaults(run=lambda a: _say(a, {"verb": "permit", "duration_s": a.seconds}))

    status = _talker(verbs, "status")
    status.set_defaults(run=run_status)


def _talker(verbs: argparse._SubParsersAction[argparse.ArgumentParser], name: str, epilog: str | None = None) -> argparse.ArgumentParser:
    verb = verbs.add_parser(name, epilog=epilog)
    _common(verb)
    return verb


def add_daemon_options(verb: argparse.ArgumentParser) -> None:
    """Which daemon is meant."""
    verb.add_argument("--robot", metavar="NAME", help="which robot, if several daemons run here")
    verb.add_argument("--socket", type=Path, metavar="PATH", help="the daemon's control socket, if it is not in the usual place")


def _common(verb: argparse.ArgumentParser) -> None:
    add_daemon_options(verb)
    verb.add_argument("--json", action="store_true", help="print one JSON object")


def run_daemon(args: argparse.Namespace, *, simulated_seeds: Iterator[int] | None = None) -> int:
    """Runs until SIGTERM or SIGINT. Exit 0 on a clean end. simulated_seeds: see `Daemon`; no option of the command line sets them."""
    from s2r_runtime.daemon import analytics
    from s2r_runtime.profile import load_driving_profile

    profile = load_driving_profile(args.profile)
    child = analytics.start()  # it loads its libraries while the daemon's are loaded here; it ends with this process
    from s2r_runtime.daemon.loop import Daemon

    daemon = Daemon(
        profile,
        profile_path=args.profile,
        state_dir=args.state,
        key_path=args.key,
        log_dir=args.log,
        seed=args.seed,
        analytics=child,
        simulated_seeds=simulated_seeds,
    )
    return daemon.run()


def run_sample(args: argparse.Namespace) -> int:
    """Exit 0 if the campaign is complete, or all of the given inputs were driven."""
    from s2r_runtime.api import live
    from s2r_runtime.daemon import control
    from s2r_runtime.profile import load_driving_profile

    profile = load_driving_profile(args.profile)
    socket = args.socket or control.find_socket(args.robot or profile.robot.name, required=False)
    if socket is not None:
        if args.output:
            raise UsageError(
                f"-o: robot {profile.robot.name!r} has a running daemon, which records the campaign in its own log; leave -o out"
            )
        if args.inputs and (args.cancel or args.pause):
            raise UsageError("--inputs: drives what is in the file; leave -n, --retry, --pause and --cancel out")
        request = live.sample_request(n=args.n, retry=args.retry, detach=args.detach, inputs=args.inputs)
        return _say(args, {"verb": "cancel"} if args.cancel else {"verb": "pause"} if args.pause else request, socket)
    if args.inputs:
        raise UsageError(f"--inputs: no daemon of robot {profile.robot.name!r} is running; start one: s2r run {args.profile}")
    for option in ("cancel", "pause", "detach"):
        if getattr(args, option):
            raise UsageError(f"--{option}: no daemon of robot {profile.robot.name!r} is running; start one: s2r run {args.profile}")
    from s2r_runtime.daemon.campaign_run import run_campaign

    out = args.output or Path(f"{profile.robot.name}-campaign.mcap")
    bar = output.Progress("sampling")
    with Presence(signals=False) as presence:  # the daemon in this process listens for them
        try:
            result = run_campaign(
                profile, args.profile, out, n=args.n, permit_s=args.permit or 3600.0, progress=bar, left=presence.look, retry=args.retry
            )
        finally:
            bar.close()
    if args.json:
        output.result_json(result)
    else:
        output.out_lines(str(result["text"]))
    return int(result["exit_code"])


def run_deploy(args: argparse.Namespace) -> int:
    """Exit 0 if the controller drives, 1 if it was refused."""
    from s2r_runtime.api import live
    from s2r_runtime.cli.choices import pairs

    request = live.deploy_request(args.controller, pairs(args.param, "--param"), args.certificate)
    code = _say(args, request)
    if code == 0 and not args.json:
        output.err("it drives on without this command; s2r undeploy ends that, s2r stop is the emergency stop")
    return code


def run_adopt(args: argparse.Namespace) -> int:
    """Exit 0 if the model is in force."""
    from s2r_runtime.api import live

    return _say(args, live.adopt_request(args.model))


def run_live_trace(args: argparse.Namespace) -> int:
    """Exit 0 with any verdict, 1 if there is none, 3 if there is nothing to trace."""
    fixed = ("profile", "model", "dt", "param", "column", "test", "horizon", "seed", "bandwidth", "suggest", "suggest_duration", "report")
    if given := [name for name in fixed if getattr(args, name, None)]:
        raise UsageError(
            f"--{given[0].replace('_', '-')}: the daemon traces as its profile says; leave it out, or name its log as RECORDING"
        )
    answer = _call(args, {"verb": "trace", "text": args.live})
    found = answer.get("data")
    trouble = output.trouble_writing(args.output, str(found["model_toml"])) if args.output and found else ""
    if args.json:
        output.result_json(answer if answer["exit_code"] or not found else found)
    elif answer["exit_code"]:
        output.err(f"s2r: {answer['text']}")
    else:
        output.out_lines(f"{answer['text']}\n{(found or {}).get('text', '')}")
    if trouble:
        output.err(f"s2r: {trouble}")
    return UsageError.exit_code if trouble else int(answer["exit_code"])


def run_status(args: argparse.Namespace) -> int:
    """Exit 0 if a daemon answers."""
    answer = _call(args, {"verb": "status"})
    data = dict(answer.get("data") or {})
    if args.json:
        output.result_json(data)
        return int(answer["exit_code"])
    gate = str(data.pop("gate", "?"))
    output.out(f"gate        {output.styled(gate, 'green' if gate == 'open' else 'yellow')}  ({data.pop('reason', '')})")
    if data.get("radius") and data.get("verified_radius"):
        output.out(f"covered     gap {data['radius']:.4g}, certified to {data['verified_radius']:.4g}")
    if driven := data.pop("driven", None):
        output.out(f"driving/gap {_ratio(driven)}")
    for line in _runs(data.pop("runs", None)):
        output.out(f"runs        {line}")
    if line := _budget(data):
        output.out(f"budget      {line}")
    for key, value in data.items():
        output.out(f"{key.replace('_', ' '):11s} {_plain(value)}")
    return int(answer["exit_code"])


def _runs(runs: dict[str, Any] | None) -> list[str]:
    """What the controller's runs on this robot show, in a line each."""
    if runs is None or runs["all"] is None:
        return []
    whole, own, highest = runs["all"], runs["under_certificate"], runs["max_unsafe"]
    lines = [str(whole["statement"])]
    if own is not None and own["number"] != whole["number"]:
        lines.append(str(own["statement"]))
    if whole["lower"] > 0.0:
        lines.append(f"at least {100.0 * whole['lower']:.2g} % are unsafe" + (f"; {100.0 * highest:g} % are allowed" if highest else ""))
    if runs["refused"]:
        lines.append("REFUSED: more than the profile allows; if the cause was removed: s2r clear unsafe_runs")
    return lines


def _ratio(driven: dict[str, Any]) -> str:
    """The driving quantile over the gap in force, as an interval, and which driving showed it."""
    low, high = ("-" if driven[key] is None else f"{driven[key]:.3g}" for key in ("ratio_lower", "ratio_upper"))
    return f"{low} to {high} (epoch {driven['epoch']}, {driven['n']} steps)"


def _budget(data: dict[str, Any]) -> str:
    """What is spent, and that there is always a next attempt: the i-th spends 3 beta / (pi^2 i^2), which sums to beta / 2."""
    campaign, attempt = data.pop("next_campaign", None), data.pop("next_attempt", None)
    if not campaign or not attempt:
        return ""
    takes = f", {campaign['n']} samples" if campaign["n"] else ""
    return (
        f"{data['beta_spent']:.3g} of beta {data['beta']:g} is spent. It never runs out: number i spends 3 beta/(pi^2 i^2), "
        f"so later ones take more samples. Next: campaign {campaign['epoch']} ({campaign['beta']:.2g}{takes}), "
        f"attempt {attempt['attempt']} ({attempt['beta']:.2g})"
    )


def _say(args: argparse.Namespace, request: dict[str, Any], socket: Path | None = None) -> int:
    answer = _call(args, request, socket)
    if args.json:
        output.result_json(answer)
    elif answer["exit_code"] == 0:
        output.out(str(answer["text"]))
    else:
        output.err(f"s2r: {answer['text']}")
    return int(answer["exit_code"])


def _call(args: argparse.Namespace, request: dict[str, Any], socket: Path | None = None) -> dict[str, Any]:
    from s2r_runtime.api import live
    from s2r_runtime.daemon import control

    path = socket or args.socket or control.find_socket(args.robot)
    if path is None:
        raise UsageError("no daemon is running here")
    watcher = output.Terminal()
    if request["verb"] not in live.WAITING:
        return live.talk(path, request, watcher)
    with Presence() as presence:
        answer = live.talk(path, request, watcher, presence)
    if presence.left and answer["exit_code"]:
        return {**answer, "exit_code": presence.exit_code, "text": f"interrupted: {answer['text']}"}
    return answer


def _plain(value: object) -> str:
    if value is None or value == [] or value == "":
        return "-"
    if isinstance(value, float):
        return f"{value:.5g}"
    if isinstance(value, list) and all(isinstance(item, dict) for item in value):  # scenarios: there may be a thousand of them
        return f"{len(value)}, the last: {_plain(value[-1])}"
    if isinstance(value, list):
        return ", ".join(map(str, value))
    if isinstance(value, dict):
        return ", ".join(f"{k} {_plain(v)}" for k, v in value.items()) or "-"
    return str(value)
