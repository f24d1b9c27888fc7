"""Pictures of the quadruped: a walk of 18 s seen from the side by a camera that goes along, 25 pictures a second of its own time."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")  # for a machine without a screen; the physics engine reads it when it is imported

RATE = 25
SIZE = (480, 848)
"""Height and width of a picture, in points."""
STORY = ((1.0, 0.0, 0.0), (4.0, 0.15, 0.0), (4.0, 0.12, 0.3), (3.0, -0.15, 0.0), (4.0, 0.0, -0.3), (2.0, 0.0, 0.0))
"""Seconds, m/s, rad/s."""
LENGTH_S = sum(seconds for seconds, _, _ in STORY)


def film(video: Path | None, folder: Path | None, effects: list[str]) -> str:
    """Makes the film; what was made, in a line. A GIF needs nothing else; other endings need ffmpeg."""
    if video is not None and video.suffix != ".gif" and shutil.which("ffmpeg") is None:
        return sys.exit(f"{video}: needs ffmpeg, which is not installed; name it .gif, or use --frames")
    pictures = _pictures(effects)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        made = 0
        for made, picture in enumerate(pictures, 1):  # each as soon as it is there: without a graphics card one takes tenths of a second
            picture.save(folder / f"{made - 1:04d}.png")
        return f"{made} pictures in {folder}"
    assert video is not None
    if video.suffix == ".gif":
        first = next(pictures)
        first.save(video, save_all=True, append_images=pictures, duration=1000 // RATE, loop=0)
    else:
        height, width = SIZE
        raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(RATE), "-i", "-"]
        argv = ["ffmpeg", "-y", "-loglevel", "error", *raw, "-pix_fmt", "yuv420p", str(video)]
        data = b"".join(picture.tobytes() for picture in pictures)
        subprocess.run(argv, input=data, check=True)
    return f"{LENGTH_S:.0f} s, {round(LENGTH_S * RATE)} pictures, in {video}"


def _pictures(effects: list[str]) -> Iterator[Any]:
    import mujoco
    from PIL import Image, ImageDraw
    from s2r_standins.quadruped_body import Quadruped

    robot = Quadruped(seed=1)
    for effect in effects:
        robot.switch_on(effect)
    camera = mujoco.MjvCamera()
    camera.distance, camera.elevation = 1.25, -12.0
    with mujoco.Renderer(robot.model, *SIZE) as renderer:
        for seconds, v, w in STORY:
            for _ in range(round(seconds * RATE)):
                x, y, theta = robot.step(v, w, 1.0 / RATE)
                camera.lookat[:] = x, y, 0.19
                camera.azimuth = 90.0 + 20.0  # a little from behind, so that the far legs are seen
                renderer.update_scene(robot.data, camera)
                picture = Image.fromarray(renderer.render())
                told = f"t {robot.now_s:5.2f} s   v {v:+.2f} m/s   w {w:+.2f} rad/s   at {x:+.2f} {y:+.2f} {theta:+.2f}   {robot.fallen}"
                ImageDraw.Draw(picture).text((10, 10), told, fill=(20, 20, 20))
                yield picture
