"""A study with all that it names: test, model, outcomes; checked before anything is computed."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from table_io.config.base import parse_toml, read_text
from table_io.config.folders import find_config, resolve_config
from table_io.config.plugins import list_entry_points, load_entry_point, make_plugin_error
from table_io.config.profile import Profile, load_profile
from table_io.errors import InputError, suggest
from table_io.units import GRAVITY_M_S2
from twin.model.config import ModelConfig
from twin.model.stepped_sine import validate_frequencies
from twin.results.contract import Contract
from twin.setup.run_config import read_model
from twin.studies.maps.cases import CaseFactory, SampledCase
from twin.studies.maps.config import StudyConfig
from twin.studies.maps.outcome_library import BRANCH_OUTCOMES, SWEEP_OUTCOMES
from twin.studies.maps.outcomes import CURVE_DIMS, ENTRY_POINT_GROUP, Outcome, OutcomeVariable


class StudyDefinition(Contract):
    """What determines every byte of the results, by which a study can be resumed.

    `store_sha256` is of the metadata and coordinates of the store, `sha256` of this file; both are
    empty in a study of an earlier version.
    """

    study_toml: str
    profile_toml: str
    model_toml: str
    versions: dict[str, str]
    store_sha256: str = ""
    sha256: str = ""


@dataclass(frozen=True)
class Study:
    """A study with the test and the model that it names, as validated objects and TOML texts."""

    config: StudyConfig
    profile: Profile
    model_config: ModelConfig
    study_toml: str
    profile_toml: str
    model_toml: str

    @classmethod
    def read(cls, path: Path) -> "Study":
        """Read a study file, found by its name in studies/ or its path, with what it names."""
        path = resolve_config(path, "studies")
        study_toml = read_text(path, "study")
        config = parse_toml(study_toml, StudyConfig, str(path))
        profile_path = find_config(config.profile, "tests", path)
        profile, profile_toml = load_profile(profile_path)
        model_config, model_toml = (
            read_model(config.model, path)
            if config.model
            else read_model(profile.model, profile_path)
        )
        study = cls(config, profile, model_config, study_toml, profile_toml, model_toml)
        study.check_cases(str(path))
        return study

    @classmethod
    def from_definition(cls, definition: StudyDefinition, source: str) -> "Study":
        """Return the study of the TOML texts of study, test and model; errors name `source`."""
        texts = definition.study_toml, definition.profile_toml, definition.model_toml
        config = parse_toml(definition.study_toml, StudyConfig, source)
        profile = parse_toml(definition.profile_toml, Profile, f"{source}: profile")
        model_config = parse_toml(definition.model_toml, ModelConfig, f"{source}: model")
        study = cls(config, profile, model_config, *texts)
        study.check_cases(source)
        return study

    @cached_property
    def outcomes(self) -> tuple[Outcome, ...]:
        return tuple(find_outcome(name) for name in self.config.outcomes)

    @cached_property
    def variables(self) -> tuple[OutcomeVariable, ...]:
        """Variables of all outcomes."""
        return tuple(variable for outcome in self.outcomes for variable in outcome.variables)

    @cached_property
    def factory(self) -> CaseFactory:
        """Builds the model and the level of a case from the values of the varied parameters."""
        return CaseFactory(
            self.model_config.build_model(self.profile.specimen),
            self.profile.sweep.one_level_g * GRAVITY_M_S2,
            self.config.fixed,
            tuple(parameter.name for parameter in self.config.parameters),
            {key: unit for outcome in self.outcomes for key, unit in outcome.settings.items()},
        )

    def check_cases(self, source: str) -> None:
        """Raise InputError, which names `source`, where a case cannot be computed.

        For an unknown parameter or outcome, or a range without a model.
        """
        try:
            self._check_cases()
        except InputError as error:
            raise error.add_place(source) from None

    def _check_cases(self) -> None:
        sweep = self.profile.sweep
        if not sweep.has_one_level:
            raise InputError(
                "its sweep has several levels",
                key="profile",
                value=self.config.profile,
                allowed="a stepped sine of one level",
                remedy="vary sweep.acceleration_g",
            )
        self._check_outcomes()
        frequencies = [step.frequency_hz for step in sweep.steps]
        validate_frequencies(frequencies, sweep.one_level_g, sweep.cycles)
        self.factory.require_keys()
        middle = [sum(parameter.limits) / 2 for parameter in self.config.parameters]
        for index, parameter in enumerate(self.config.parameters):
            for value in parameter.limits:
                values: Sequence[float] = [*middle[:index], value, *middle[index + 1 :]]
                try:
                    case = self.factory.build(values)
                    case.find_resonance()
                except InputError as error:
                    raise error.add_place(f"{parameter.name} = {value:g}") from None
                self._require_closed_forms(case)

    def _require_closed_forms(self, case: SampledCase) -> None:
        """Raise InputError if an outcome cannot be computed of a model with force laws."""
        if case.model.changes_only_parameters:
            return
        laws = [i.name for i in case.model.present_effects if i.effect.acts != "parameters"]
        for outcome in self.outcomes:
            if outcome.needs_closed_form:
                raise InputError(
                    f"{outcome.title}: not of a model with {', '.join(laws)}, whose branches take "
                    "minutes",
                    key="outcomes",
                    value=outcome.name,
                    remedy="compute hysteresis instead, or follow single branches by `branches`",
                )

    def _check_outcomes(self) -> None:
        """Raise InputError for outcomes that are unknown, repeated, or need another sweep."""
        names = [variable.name for variable in self.variables]
        if len(set(names)) < len(names):
            raise InputError("each outcome, and each variable of one, at most once", key="outcomes")
        for outcome in self.outcomes:
            if outcome.needs_both_directions and len(self.profile.sweep.directions) < 2:
                raise InputError(
                    f"{outcome.title} need a sweep in both directions",
                    key="outcomes",
                    value=outcome.name,
                    remedy="give a test that sweeps forward and backward",
                )
            stated = [*self.config.fixed, *(p.name for p in self.config.parameters)]
            for key in outcome.required:
                if key not in stated:
                    raise InputError(
                        f"{outcome.title} need it",
                        key=key,
                        remedy="add it to [fixed] or to the parameters",
                    )
        front = self.config.front
        if front is None:
            return
        scalars = [variable.name for variable in self.variables if not variable.dims]
        for name in front.minimise:
            if name not in scalars:
                raise InputError(
                    "not computed", key="front.minimise", value=name, remedy=suggest(name, scalars)
                )
        parameters = [parameter.name for parameter in self.config.parameters]
        if front.each and self.config.sampling != "grid":
            raise InputError(
                "samples have no repeated values", key="front.each", remedy="omit it, or use a grid"
            )
        if front.each and front.each not in parameters:
            raise InputError(
                "no parameter of the study",
                key="front.each",
                value=front.each,
                remedy=suggest(front.each, parameters),
            )


def find_outcome(name: str) -> Outcome:
    """Return an outcome, built-in before plug-in; InputError names the nearest."""
    known: Iterable[Outcome] = (*SWEEP_OUTCOMES, *BRANCH_OUTCOMES)
    for outcome in known:
        if outcome.name == name:
            return outcome
    plugin = load_entry_point(ENTRY_POINT_GROUP, name)
    if plugin is None:
        names = [*(o.name for o in known), *list_entry_points(ENTRY_POINT_GROUP)]
        raise InputError("no such outcome", key="outcomes", value=name, remedy=suggest(name, names))
    if not isinstance(plugin, Outcome):
        entry = list_entry_points(ENTRY_POINT_GROUP)[name][0]
        problem = f"expected an Outcome, got {type(plugin).__name__}"
        raise make_plugin_error(entry, ENTRY_POINT_GROUP, problem)
    for variable in plugin.variables:
        if np.dtype(variable.dtype).kind != "f" or not set(variable.dims) <= set(CURVE_DIMS):
            entry = list_entry_points(ENTRY_POINT_GROUP)[name][0]
            problem = f"variable {variable.name}: dtype a float, dims of {', '.join(CURVE_DIMS)}"
            raise make_plugin_error(entry, ENTRY_POINT_GROUP, problem)
    return plugin
