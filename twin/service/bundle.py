"""A test profile with its machine card, model and drive, checked together before anything moves."""

import platform
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from table_io.card import BadInput, find, load, parse
from table_io.clock import today
from table_io.conductor import rehearsed, score
from table_io.course import plan
from table_io.drive import Drive
from table_io.limits import Margin, margins, refuse
from table_io.profile import Profile
from table_io.records import RunStart, Step
from table_io.rig import Rig
from table_io.rig_file import load_rig
from table_io.session import Setup as SessionSetup
from twin.model.card import ModelCard
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.service.versions import installed

if TYPE_CHECKING:
    from twin.compare.pipeline import Setup

WARM_ITEMS = 100  # of a session: one second; each kernel runs from the first blocks on


@dataclass(frozen=True)
class Bundle:
    """All that a run needs, as texts and as what they mean.

    `drive` is what will be played if the loop check passes and no level needs a correction.
    """

    name: str
    profile: Profile
    rig: Rig
    model: Model
    drive: Drive
    margins: tuple[Margin, ...]
    profile_toml: str
    rig_toml: str
    model_toml: str

    @property
    def session(self) -> SessionSetup:
        return SessionSetup(self.profile, self.rig)

    def twin(self, from_rest: bool = False) -> "Setup":
        """The twin's setup; importing it compiles its kernels where they are not cached."""
        from twin.compare import pipeline

        setup = pipeline.prepare(self.profile, self.model, self.steps, from_rest)
        setup.twin.solver  # noqa: B018  compiled now, not at the first sample
        return setup

    @property
    def ideal(self) -> Drive:
        """The sweep alone, as an ideal table plays it: no loop check, nothing to tune."""
        return plan(self.profile)

    @property
    def parameters(self) -> Parameters:
        """The linear part of the model."""
        return self.model.parameters

    @property
    def steps(self) -> tuple[Step, ...]:
        return self.drive.steps

    def describe(self, run: str, source: str) -> Callable[[dict[str, float], float], RunStart]:
        """What makes the RunStart once tare and epoch are known."""

        def start(tare: dict[str, float], epoch_s: float) -> RunStart:
            table = ("drive_disp_m", "table_disp_m", "table_acc_m_s2")
            return RunStart(
                index=0,
                run=run,
                name=self.name,
                source=source,
                profile_toml=self.profile_toml,
                rig_toml=self.rig_toml,
                model_toml=self.model_toml,
                rate_hz=self.profile.acquisition.rate_hz,
                block_samples=self.profile.acquisition.block_samples,
                channels=self.rig.channels if source == "table" else table,
                steps=self.steps,
                planned_samples=self.drive.planned_end,
                tare=tare,
                versions=dict(installed()),
                host=platform.node(),
                started_at=today().isoformat(timespec="seconds"),
                epoch_s=epoch_s,
            )

        return start


def from_texts(name: str, profile_toml: str, rig_toml: str, model_toml: str, where: str) -> Bundle:
    """A bundle from texts that were read or recorded; BadInput with every fault of each."""
    profile = parse(profile_toml, Profile, where)
    rig = parse(rig_toml, Rig, f"machine card of {where}")
    card = parse(model_toml, ModelCard, f"model of {where}")
    try:
        drive = rehearsed(score(profile, rig))
    except ArithmeticError as error:
        raise BadInput(
            f"{where}: no drive follows from these numbers ({error}); look for a wrong power of ten"
        ) from None
    model = card.model(profile.specimen)
    model.fits(profile.acquisition.rate_hz)
    return Bundle(
        name,
        profile,
        rig,
        model,
        drive,
        margins(drive, profile, rig),
        profile_toml,
        rig_toml,
        model_toml,
    )


def read_bundle(path: Path, table: str | None = None, model: str | None = None) -> Bundle:
    """The bundle of a test profile; BadInput where the table cannot do the test."""
    profile, profile_toml = load(path, Profile, "test profile")
    _, rig_toml = load_rig(find(table or profile.rig, "rigs", path))
    _, model_toml = read_model(model or profile.model, path)
    bundle = from_texts(path.stem, profile_toml, rig_toml, model_toml, str(path))
    refuse(bundle.margins, bundle.profile, bundle.rig, str(path))
    return bundle


def read_model(name: str, beside: Path | None = None) -> tuple[ModelCard, str]:
    """(model card, its text) of a name in models/ or a path."""
    return load(find(name, "models", beside), ModelCard, "model")


def run_id(name: str) -> str:
    """<date>-<time>-<profile>: the run's id and the name of its folder."""
    return f"{today():%Y%m%d-%H%M%S}-{name}"


def warm_twin() -> None:
    """Compile or load the kernels of the exact solver by running them once on a few samples."""
    import numpy as np

    from twin.model.exact import advance, constants, rest

    parameters = Parameters(550.0, 36e3, 1.1e3, 510e3, 900.0, 510e3, 900.0, 0.002, 0.002)
    state = rest(parameters)
    advance(state, constants(parameters, 2000.0), np.zeros(4), np.empty((7, 4)))


def warm_rig(bundle: Bundle) -> None:
    """Compile or load what the rig computes with, protection too, and its simulated table.

    The beginning of a real session is played: nothing can be forgotten here. A card that cannot
    play, for it has no simulated table or no command, is warmed by the quickstart's.
    """
    from contextlib import closing
    from itertools import islice

    from table_io.backends.simulated import SimulatedBackend
    from table_io.clock import ManualClock
    from table_io.session import play

    if bundle.rig.simulated is None or "drive_disp_m" not in bundle.rig.channels:
        bundle = read_bundle(find("quickstart", "tests"))
    clock = ManualClock()
    backend = SimulatedBackend(
        bundle.rig, bundle.profile.specimen, bundle.profile.acquisition.rate_hz, clock
    )
    session = play(bundle.session, backend, clock, bundle.describe("warm", "table"), lambda: None)
    with closing(session):  # which closes the backend too
        for _ in islice(session, WARM_ITEMS):
            pass
