"""A folder of keys is looked at before it is used, and each fault of it is said."""

import json
import shutil
from datetime import UTC, timedelta
from pathlib import Path

import pytest

from table_io.clock import local_datetime
from table_io.errors import InputError
from tests.input_errors import raises_input_error
from tests.security.laboratory import PEOPLE, aged, laboratory, own, write_keys
from twin.security.access_control import NO_ROLE, build_open_access, build_people_access
from twin.security.certificate_authority import CertificateKeyPair, issue_certificate
from twin.security.credentials import check_name, read_credentials, read_rig_credentials


@pytest.fixture(scope="module")
def made_lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return laboratory(tmp_path_factory.mktemp("keys") / "lab")


@pytest.fixture
def lab(made_lab: Path, tmp_path: Path) -> Path:
    """One that may be damaged."""
    return shutil.copytree(made_lab, tmp_path / "lab")


def test_read_credentials_returns_the_name(made_lab: Path) -> None:
    keys = read_credentials(own(made_lab, "anna"))
    assert (keys.name, keys.people) == ("anna", None)
    rig = read_credentials(made_lab)
    assert rig.name == "rig"
    assert rig.people == {name: role for name, role in PEOPLE.items() if name != "gone"}


@pytest.mark.parametrize("name", ["ca.pem", "certificate.pem", "key.pem"])
def test_a_missing_file_is_named(lab: Path, name: str) -> None:
    (own(lab, "anna") / name).unlink()
    folder = own(lab, "anna")
    with raises_input_error(key="--keys", value=str(folder), problem=name, remedy="keys add"):
        read_credentials(own(lab, "anna"))


@pytest.mark.parametrize(
    "name, says",
    [
        ("ca.pem", "not the certificate of an authority"),
        ("certificate.pem", "damaged, encrypted or no PEM file"),
        ("key.pem", "damaged, encrypted or no PEM file"),
    ],
)
@pytest.mark.parametrize(
    "content", [b"", b"-----BEGIN CERTIFICATE-----\nAAAA\n", bytes(range(256))]
)
def test_a_damaged_file_is_no_key(lab: Path, name: str, says: str, content: bytes) -> None:
    (own(lab, "anna") / name).write_bytes(content)
    with pytest.raises(InputError, match=says) as error:
        read_credentials(own(lab, "anna"))
    place = error.value.where or error.value.value
    assert place == str(own(lab, "anna") / name if name == "ca.pem" else own(lab, "anna"))
    assert "ask for" in error.value.remedy


def test_a_key_of_another_certificate_is_refused(lab: Path) -> None:
    shutil.copy(own(lab, "bob") / "key.pem", own(lab, "anna") / "key.pem")
    with pytest.raises(InputError, match=r"key\.pem does not belong to certificate\.pem"):
        read_credentials(own(lab, "anna"))


def test_a_certificate_of_another_authority_is_refused(lab: Path, tmp_path: Path) -> None:
    other = laboratory(tmp_path / "other")
    shutil.copy(other / "ca.pem", own(lab, "anna") / "ca.pem")
    with pytest.raises(InputError, match=r"not issued by the authority in ca\.pem") as error:
        read_credentials(own(lab, "anna"))
    assert error.value.where == str(own(lab, "anna") / "certificate.pem")


def test_a_person_is_no_authority(lab: Path, tmp_path: Path) -> None:
    """Neither for a certificate that a person signed, nor by a ca.pem that is a person's."""
    pair = CertificateKeyPair(
        *((own(lab, "bob") / name).read_bytes() for name in ("certificate.pem", "key.pem"))
    )
    false = issue_certificate(pair, "anna", [], local_datetime())
    chain = CertificateKeyPair(false.certificate + pair.certificate, false.key)
    forged = write_keys(tmp_path / "forged", lab, chain)
    for _ in range(2):
        with pytest.raises(InputError, match=r"not issued by the authority in ca\.pem"):
            read_credentials(forged)
        shutil.copy(own(lab, "bob") / "certificate.pem", forged / "ca.pem")


@pytest.mark.parametrize(
    "days, problem, remedy",
    [(366.0, "expired", "keys renew"), (-2.0, "not yet valid", "check the clock")],
)
def test_a_certificate_out_of_time_says_from_when_to_when(
    lab: Path, tmp_path: Path, days: float, problem: str, remedy: str
) -> None:
    keys = aged(lab, tmp_path / "aged", "anna", days)
    with pytest.raises(InputError) as error:
        read_credentials(keys)
    assert error.value.where == str(keys / "certificate.pem")
    assert error.value.problem.startswith(problem)
    assert remedy in error.value.remedy
    valid_until = local_datetime() + timedelta(days=365 - days)
    assert error.value.allowed.endswith(f" to {valid_until.astimezone(UTC):%Y-%m-%d}")


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o644])
def test_a_private_key_that_others_may_read_is_refused(lab: Path, mode: int) -> None:
    (own(lab, "anna") / "key.pem").chmod(mode)
    with pytest.raises(InputError, match="others on this machine may read it") as error:
        read_credentials(own(lab, "anna"))
    path = own(lab, "anna") / "key.pem"
    assert (error.value.where, error.value.value) == (str(path), f"{mode:04o}")
    assert error.value.remedy == f"chmod go-rwx {path}"


def test_an_access_list_that_others_may_write_is_refused(lab: Path) -> None:
    (lab / "access.toml").chmod(0o664)
    with pytest.raises(InputError, match="others may change it") as error:
        read_credentials(lab)
    assert (error.value.where, error.value.value) == (str(lab / "access.toml"), "0664")
    assert error.value.remedy == f"chmod go-w {lab / 'access.toml'}"


@pytest.mark.parametrize(
    "text, fields",
    [
        (
            '[people]\nanna = "admin"\n',
            {"key": "people.anna", "value": "admin", "problem": "'observe', 'record'"},
        ),
        ('[people]\nAnna = "observe"\n', {"key": "people.Anna.[key]", "allowed": "up to 64"}),
        ('[people]\n"a.b" = "observe"\n', {"key": "people.a.b.[key]", "allowed": "up to 64"}),
        ('[people]\nnone = "command"\n', {"key": "people.none.[key]"}),
        ('[peolpe]\nanna = "command"\n', {"key": "peolpe", "remedy": "'people'"}),
        ("", {"key": "people"}),
        ("[people\n", {"problem": "TOML"}),
    ],
)
def test_a_wrong_access_list_names_the_fault(
    lab: Path, text: str, fields: dict[str, object]
) -> None:
    (lab / "access.toml").write_text(text)
    with raises_input_error(**fields):
        read_credentials(lab)


def test_role_is_read_again_and_none_in_a_broken_list(lab: Path) -> None:
    keys = read_credentials(lab)
    assert [keys.role_of(who) for who in ("anna", "bob", "gone", "")] == [
        *("command", "observe"),
        *(NO_ROLE, NO_ROLE),
    ]
    (lab / "access.toml").write_text('[people]\nbob = "command"\n')
    assert [keys.role_of(who) for who in ("anna", "bob")] == [NO_ROLE, "command"]
    (lab / "access.toml").write_text("[people\n")
    assert keys.role_of("bob") == NO_ROLE
    (lab / "access.toml").unlink()
    assert keys.role_of("bob") == NO_ROLE


def test_a_persons_keys_cannot_open_a_rig(made_lab: Path) -> None:
    folder = own(made_lab, "anna")
    with raises_input_error(key="--keys", value=str(folder), remedy="access.toml"):
        read_rig_credentials(folder)
    assert read_rig_credentials(made_lab).people


@pytest.mark.parametrize("name", ["", "a" * 65, "A", "a.b", "-a", "_a", "a/b", "a b", "rig", "é"])
def test_ambiguous_or_reserved_name_is_refused(name: str) -> None:
    with pytest.raises(InputError) as error:
        check_name(name)
    assert error.value.value == name
    assert error.value.allowed or error.value.remedy


def test_the_rules_only_allow_and_the_default_denies() -> None:
    """A denying rule is escaped by a wider key; and an empty list means everybody to zenoh."""
    for access in (
        build_people_access("r", {}),
        build_people_access("r", PEOPLE),
        build_open_access("r"),
    ):
        control = access["access_control"]
        assert control["default_permission"] == "deny"
        assert {rule["permission"] for rule in control["rules"]} == {"allow"}
        assert "[]" not in json.dumps(control)
        assert all(
            key.startswith("shaketwin/r/") for rule in control["rules"] for key in rule["key_exprs"]
        )
