"""Models in the robot's state folder: adopted ones, and repaired ones that wait to be adopted.

    models/<digest>.toml    a model; `base` is the digest of the profile's model in whose place it may come

A file alone puts nothing in force: the memory must name its digest (that is a decision, and logged), and a profile whose own model was
changed since has the last word. Two files of one digest compute the same; what they were fitted on is united (guarantee G6).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec

from s2r_runtime.errors import ConfigError
from s2r_runtime.files.durable import replace
from s2r_runtime.files.toml_text import load_toml
from s2r_runtime.messages import Memory
from s2r_runtime.modelspec import ModelSpec, dump_model, load_model
from s2r_runtime.profile import Profile

DIGITS = 16
"""Of a digest, in a file's name; what is in the file is compared with all of it."""


class ModelStore:
    """Keeps models by digest. base: digest of the profile's model, as the profile's file has it."""

    def __init__(self, folder: Path, base: str) -> None:
        self.folder, self.base = folder, base

    def file(self, digest: str) -> Path:
        """Where the model of that digest is, or would be."""
        return self.folder / "models" / f"{digest.removeprefix('sha256:')[:DIGITS]}.toml"

    def load(self, digest: str) -> ModelSpec | None:
        """The model of that digest; None if there is none for this profile. Raises ConfigError if its file is damaged."""
        file = self.file(digest)
        if not file.exists():
            file = self.folder / "model.toml"  # where version 0.1 kept the adopted one
        if not file.exists() or not _of_base(file, self.base):
            return None
        spec = load_model(file)
        if spec.digest() != digest:
            raise ConfigError(f"{file}: is not the model that was adopted ({digest}); put it back, or adopt a model again")
        return spec

    def in_force(self, profile: Profile, memory: Memory) -> Profile:
        """The profile with the adopted model, if there is one. Raises ConfigError if its file is damaged."""
        if not memory.model_digest or memory.model_digest == self.base:
            return profile
        spec = self.load(memory.model_digest)
        return profile if spec is None else msgspec.structs.replace(profile, model=spec)

    def keep(self, spec: ModelSpec, comments: Sequence[str] = ()) -> ModelSpec:
        """Puts the model there, durably, before any memory names it; gives it back with all that it was fitted on. Raises OSError."""
        from s2r_runtime.evidence.seen_rows import united

        digest, file = spec.digest(), self.file(spec.digest())
        if file.exists() and _of_base(file, self.base) and (known := load_model(file)).digest() == digest:
            spec = msgspec.structs.replace(spec, fitted_on=united(known.fitted_on, spec.fitted_on))
        file.parent.mkdir(mode=0o700, exist_ok=True)
        replace(file, (f'base = "{self.base}"\n' + dump_model(spec, tuple(comments))).encode())
        return spec


def _of_base(file: Path, base: str) -> bool:
    try:
        return bool(load_toml(file).get("base") == base)
    except ConfigError as error:
        raise ConfigError(f"{file}: is damaged: {error}") from None
