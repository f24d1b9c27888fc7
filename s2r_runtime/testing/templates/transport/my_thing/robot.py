"""A robot to begin with: a unicycle in this computer, in lockstep. `python -m my_thing.robot --gain 0.9` is one that turns too little.

It says where it is, waits for the command that answers that, drives one period and goes on; while it waits it says it again. So it
runs as fast as it is answered. A real robot says where it is when its clock says so, and drives on with the newest command until that
one's time to live is over.
"""

import argparse
import json
import math
import random
import socket

DT, AGAIN_S = 0.033, 0.1


def run(port, robot_port, gain, seed):
    noise = random.Random(seed)
    x, y, theta, seq = 0.0, 0.0, 0.0, 0
    line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    line.bind(("127.0.0.1", robot_port))
    line.settimeout(AGAIN_S)
    while True:
        measured = [value + noise.gauss(0.0, 1e-4) for value in (x, y, theta)]
        observation = {"type": "observation", "seq": seq, "stamp_ns": round(seq * DT * 1e9), "x": measured}
        v, w = answer(line, ("127.0.0.1", port), json.dumps(observation).encode(), seq)
        w *= gain
        x, y, theta = x + DT * v * math.cos(theta), y + DT * v * math.sin(theta), math.remainder(theta + DT * w, 2.0 * math.pi)
        seq += 1


def answer(line, runtime, observation, seq):
    """The command to this observation."""
    while True:
        line.sendto(observation, runtime)
        try:
            while True:
                command = json.loads(line.recv(65536))
                if command["obs_seq"] == seq:
                    return command["u"]
        except (TimeoutError, ConnectionRefusedError):
            pass


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="A unicycle that sends JSON over UDP.")
    parser.add_argument("--port", type=int, default=7481, help="the runtime's port (default 7481)")
    parser.add_argument("--robot-port", type=int, default=7482, help="its own (default 7482)")
    parser.add_argument("--gain", type=float, default=1.0, help="of its yaw rate (default 1)")
    parser.add_argument("--seed", type=int, default=1, help="of its noise (default 1)")
    o = parser.parse_args()
    run(o.port, o.robot_port, o.gain, o.seed)
