"""The adopted model, in the robot's state folder, and repaired models that wait to be adopted.

    model.toml          the model in force, if it isn't the profile's; `base` is the digest of the profile's model it replaced
    models/<name>.toml  what tracing proposed

The file alone puts nothing in force: the memory must name its digest (that is a person's decision, and logged), and a profile whose
own model was changed since has the last word.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import msgspec

from s2r_runtime.daemon.persistence import replace
from s2r_runtime.errors import ConfigError
from s2r_runtime.messages import Memory
from s2r_runtime.modelspec import ModelSpec, dump_model, load_model
from s2r_runtime.profile import Profile


class ModelStore:
    """Keeps the model that a person adopted. profile_model: as the profile's file has it."""

    def __init__(self, folder: Path, profile_model: ModelSpec) -> None:
        self._folder, self._base = folder, profile_model.digest()

    def in_force(self, profile: Profile, memory: Memory) -> Profile:
        """The profile with the adopted model, if there is one. Raises ConfigError if its file is damaged."""
        file = self._folder / "model.toml"
        if not memory.model_digest or memory.model_digest == self._base or not file.exists():
            return profile
        if tomllib.loads(file.read_text(encoding="utf-8")).get("base") != self._base:
            return profile
        spec = load_model(file)
        if spec.digest() != memory.model_digest:
            raise ConfigError(f"{file}: is not the model that was adopted ({memory.model_digest}); put it back, or adopt a model again")
        return msgspec.structs.replace(profile, model=spec)

    def keep(self, spec: ModelSpec) -> None:
        """Puts the model beside the memory, durably, before the memory names it. Raises OSError."""
        text = f'base = "{self._base}"\n' + dump_model(spec, ("Adopted; the daemon's own file.",))
        replace(self._folder / "model.toml", text.encode())

    def proposal(self, name: str) -> Path:
        """Where a repaired model of that name is written."""
        folder = self._folder / "models"
        folder.mkdir(mode=0o700, exist_ok=True)
        return folder / f"{name}.toml"


def parse_model(text: str, base: str, where: str) -> ModelSpec:
    """A model from the text of a TOML; a Python file in it is looked up from `base`. Raises ConfigError."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{where}: not TOML: {error}") from None
    if "model" not in table:
        raise ConfigError(f"{where}: has no [model] table")
    try:
        spec = msgspec.convert(table["model"], ModelSpec)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{where}: model: {error}") from None
    if spec.name.endswith(".py"):
        path = Path(base) / spec.name
        spec = msgspec.structs.replace(spec, name=str(path.resolve()))
    return spec
