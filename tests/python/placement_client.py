#!/usr/bin/env python3
"""Brings the instrument to a target's standoff from outside, in plain Zenoh and JSON.

    pip install eclipse-zenoh==1.10.2
    rover up --listen tcp/127.0.0.1:7447
    python3 placement_client.py --connect tcp/127.0.0.1:7447 --namespace bluestreak 320 285

It reads the arm's state, selects the target under a pixel, lets the planner look, commands the
servo and sends its heartbeats until the goal has ended. Ctrl-C cancels the goal. The result goes
to standard output as JSON, messages to standard error.

Exit codes: 0 at the standoff, 1 network or internal failure, 2 bad input, 3 refused or ended
without placing the instrument.
"""

import argparse
import json
import sys
import uuid

import zenoh

PAIR_HELP = "camera pair whose left image the pixel belongs to"


class Refused(Exception):
    """A fault that a service answered: name, service, message, details."""

    def __init__(self, fault):
        self.fault = fault
        numbers = "".join(f", {key} = {value:g}" for key, value in fault["details"].items())
        super().__init__(f"{fault['service']}: {fault['name']}: {fault['message']}{numbers}")


class NetworkError(Exception):
    """Nobody answered, or not in time, or not in JSON."""


def say(text):
    print(text, file=sys.stderr, flush=True)


def ask(session, key, question=None, limit_s=30.0):
    """One question, one answer; no question reads a stream's latest value."""
    payload = {}
    if question is not None:
        text = json.dumps(question, allow_nan=False)
        payload = {"payload": text, "encoding": zenoh.Encoding.APPLICATION_JSON}
    for reply in session.get(key, timeout=limit_s, **payload):
        if reply.ok is not None:
            return decoded(key, reply.ok)
        if reply.err.payload.to_bytes() == b"Timeout":
            raise NetworkError(f"{key}: no answer within {limit_s:g} s")
        fault = decoded(key, reply.err)
        if not isinstance(fault, dict) or "name" not in fault:
            raise NetworkError(f"{key}: {fault!r}, expected an answer or a fault")
        raise Refused(fault)
    raise NetworkError(f"{key}: nobody serves it; is the namespace right and the rover up?")


def decoded(key, reply):
    try:
        return json.loads(reply.payload.to_bytes())
    except ValueError as error:
        raise NetworkError(f"{key}: answer marked `{reply.encoding}` is not JSON: {error}") from None


def is_present(session, key):
    return any(reply.ok is not None for reply in session.liveliness().get(key, timeout=5.0))


def command(session, key, commander, goal, on_feedback, limit_s=30.0):
    """Sends a goal and its heartbeats until it has ended; gives the result."""
    goal_id = f"{commander}-{uuid.uuid4().hex[:8]}"
    request = {"goal_id": goal_id, "commander": commander, "goal": goal}
    seq = 0
    try:
        ask(session, key, request, limit_s)
        while True:
            seq += 1  # the same number twice would be one heartbeat
            progress = ask(session, f"{key}/beat", {"goal_id": goal_id, "seq": seq}, limit_s)
            if progress["feedback"] is not None:
                on_feedback(progress["feedback"])
            if progress["state"] == "succeeded":
                return progress["result"]
            if progress["fault"] is not None:
                raise Refused(progress["fault"])
            if progress["state"] == "unknown":
                raise NetworkError(f"{key}: goal `{goal_id}` is forgotten; its server has restarted")
    except (KeyboardInterrupt, NetworkError):
        say(f"{key}: cancelling goal {goal_id}")
        try:
            ask(session, f"{key}/cancel", {"goal_id": goal_id}, 5.0)
        except (NetworkError, Refused) as error:
            say(f"{key}: not cancelled: {error}")
        raise


def place(session, options):
    def at(key):
        return f"{options.namespace}/{key}"

    state = ask(session, at("arm/state"))
    joints = " ".join(f"{angle:.4f}" for angle in state["joints_rad"])
    say(f"arm is {state['motion']} at [{joints}] rad, {state['sim_time_s']:.2f} s")

    token = at(f"presence/{options.name}")
    if is_present(session, token):
        raise NetworkError(f"`{options.name}` is already present, expected another --name")
    presence = session.liveliness().declare_token(token)
    try:
        question = {"pair": options.pair, "pixel_px": [options.u_px, options.v_px]}
        target = ask(session, at("target/select"), question)
        position = ", ".join(f"{x:.4f}" for x in target["position_m"])
        say(f"target at ({position}) m, plane rms {target['plane_rms_mm']:.2f} mm")

        survey = ask(session, at("planner/survey"), {"pair": options.pair}, options.limit_s)
        say(f"planner's map holds {survey['points_n']} points")

        shown = None

        def show(feedback):
            nonlocal shown
            look = feedback["look"]
            news = (feedback["activity"], look)
            if news == shown:
                return
            shown = news
            text = f"{feedback['activity']}, {feedback['distance_m'] * 1e3:.1f} mm from the target"
            if feedback["activity"] == "looking" and look is not None:
                found = "seen" if look["found"] else f"not seen ({look['reason']})"
                text += f"; fiducial {found} at {look['station_m'] * 1e3:.0f} mm"
            say(text)

        goal = {
            "target": target,
            "stations_m": [station * 1e-3 for station in options.stations_mm],
            "tolerance_m": options.tolerance_mm * 1e-3,
            "max_corrections_n": options.max_corrections_n,
            "max_predicted_error_m": options.max_predicted_error_mm * 1e-3,
        }
        placed = command(session, at("servo/place"), options.name, goal, show, options.limit_s)
        return {"target": target, "placed": placed}
    finally:
        presence.undeclare()


def parse():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("u_px", type=float, help="column of the target in the left image, px")
    parser.add_argument("v_px", type=float, help="row of the target in the left image, px")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="endpoint of any peer")
    parser.add_argument("--namespace", default="rover", help="prefix of the robot's keys")
    parser.add_argument("--name", default="placement_client", help="name to be present under")
    parser.add_argument("--pair", default="body", help=PAIR_HELP)
    parser.add_argument(
        "--stations-mm", type=float, nargs="+", default=[160.0, 120.0, 90.0, 60.0, 30.0],
        help="distances from the target at which to look, far to near; the last is the standoff",
    )
    parser.add_argument("--tolerance-mm", type=float, default=0.1)
    parser.add_argument("--max-corrections-n", type=int, default=4)
    parser.add_argument("--max-predicted-error-mm", type=float, default=10.0)
    parser.add_argument("--limit-s", type=float, default=120.0, help="limit for one answer")
    options = parser.parse_args()
    if any(far <= near for far, near in zip(options.stations_mm, options.stations_mm[1:])):
        parser.error(f"--stations-mm: {options.stations_mm}, expected far to near")
    if not options.name or any(c in options.name for c in "/*$?#"):
        parser.error(f"--name: `{options.name}`, expected one word without / * $ ? #")
    if options.limit_s <= 0:
        parser.error(f"--limit-s: {options.limit_s}, expected more than 0")
    return options


def main():
    options = parse()
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([options.connect]))
    config.insert_json5("scouting/multicast/enabled", "false")
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        say(f"error: no session through `{options.connect}`: {error}")
        return 1
    try:  # a session that is not closed keeps Python from ending
        with session:
            print(json.dumps(place(session, options), indent=2))
            return 0
    except Refused as refusal:
        say(f"refused: {refusal}")
        return 3
    except NetworkError as error:
        say(f"error: {error}")
        return 1
    except zenoh.ZError as error:
        say(f"error: zenoh: {error}")
        return 1
    except KeyboardInterrupt:
        say("cancelled")
        return 3


if __name__ == "__main__":
    sys.exit(main())
