"""A folder of keys is looked at before it is used, and each fault of it is said."""

import json
import shutil
from pathlib import Path

import pytest

from table_io.errors import InputError
from tests.security.laboratory import PEOPLE, aged, laboratory, own
from twin.security.access_control import NO_ROLE, build_open_access, build_people_access
from twin.security.credentials import check_name, read_credentials, read_rig_credentials


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return laboratory(tmp_path_factory.mktemp("keys") / "lab")


@pytest.fixture
def lab(made: Path, tmp_path: Path) -> Path:
    """One that may be damaged."""
    return shutil.copytree(made, tmp_path / "lab")


def test_a_folder_in_order_says_whose_it_is(made: Path) -> None:
    keys = read_credentials(own(made, "anna"))
    assert (keys.name, keys.people) == ("anna", None)
    rig = read_credentials(made)
    assert rig.name == "rig"
    assert rig.people == {name: role for name, role in PEOPLE.items() if name != "gone"}


@pytest.mark.parametrize("name", ["ca.pem", "certificate.pem", "key.pem"])
def test_a_missing_file_is_named(lab: Path, name: str) -> None:
    (own(lab, "anna") / name).unlink()
    with pytest.raises(InputError, match=rf"--keys .*anna: {name} is missing"):
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
    with pytest.raises(InputError, match=says):
        read_credentials(own(lab, "anna"))


def test_a_key_of_another_certificate_is_refused(lab: Path) -> None:
    shutil.copy(own(lab, "bob") / "key.pem", own(lab, "anna") / "key.pem")
    with pytest.raises(InputError, match=r"key\.pem does not belong to certificate\.pem"):
        read_credentials(own(lab, "anna"))


def test_a_certificate_of_another_authority_is_refused(lab: Path, tmp_path: Path) -> None:
    other = laboratory(tmp_path / "other")
    shutil.copy(other / "ca.pem", own(lab, "anna") / "ca.pem")
    with pytest.raises(InputError, match=r"not issued by the authority in ca\.pem"):
        read_credentials(own(lab, "anna"))


@pytest.mark.parametrize(
    "days, says", [(366.0, "expired; ask for new keys"), (-2.0, "not yet valid; check the clock")]
)
def test_a_certificate_out_of_time_says_from_when_to_when(
    lab: Path, tmp_path: Path, days: float, says: str
) -> None:
    keys = aged(lab, tmp_path / "aged", "anna", days)
    with pytest.raises(InputError, match=rf"valid from 20\d\d-\d\d-\d\d to 20.*{says}"):
        read_credentials(keys)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o644])
def test_a_private_key_that_others_may_read_is_refused(lab: Path, mode: int) -> None:
    (own(lab, "anna") / "key.pem").chmod(mode)
    with pytest.raises(InputError, match=rf"mode {mode:04o}, others .* may read it; chmod go-rwx"):
        read_credentials(own(lab, "anna"))


def test_an_access_list_that_others_may_write_is_refused(lab: Path) -> None:
    (lab / "access.toml").chmod(0o664)
    with pytest.raises(InputError, match="mode 0664, others may change it; chmod go-w"):
        read_credentials(lab)


@pytest.mark.parametrize(
    "text, says",
    [
        ('[people]\nanna = "admin"\n', r"people\.anna = 'admin'.*'observe', 'record'"),
        ('[people]\nAnna = "observe"\n', r"people\.Anna.*allowed: up to 64"),
        ('[people]\n"a.b" = "observe"\n', r"people\.a\.b.*allowed: up to 64"),
        ('[people]\nnone = "command"\n', "'none' is a reserved name"),
        ('[peolpe]\nanna = "command"\n', "did you mean 'people'"),
        ("", "people: missing"),
        ("[people\n", "not valid TOML"),
    ],
)
def test_a_wrong_access_list_names_the_fault(lab: Path, text: str, says: str) -> None:
    (lab / "access.toml").write_text(text)
    with pytest.raises(InputError, match=says):
        read_credentials(lab)


def test_a_role_is_looked_up_anew_and_nobody_has_one_in_a_broken_list(lab: Path) -> None:
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


def test_a_persons_keys_cannot_open_a_rig(made: Path) -> None:
    with pytest.raises(InputError, match="keys of anna"):
        read_rig_credentials(own(made, "anna"))
    assert read_rig_credentials(made).people


@pytest.mark.parametrize("name", ["", "a" * 65, "A", "a.b", "-a", "_a", "a/b", "a b", "rig", "é"])
def test_a_name_that_could_be_taken_for_something_else_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="'"):
        check_name(name)


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
