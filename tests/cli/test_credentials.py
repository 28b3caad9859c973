"""`shaketwin keys`: what it makes is sound, complete, private, and never overwritten."""

import errno
import os
import re
import shlex
import shutil
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

import pytest
import typer
from cryptography import x509
from cryptography.x509.verification import PolicyBuilder, Store, VerificationError
from typer.testing import CliRunner

from table_io.clock import local_datetime
from table_io.errors import InputError
from tests.input_errors import raises_input_error
from twin import options
from twin.rig import keys
from twin.rig.keys import (
    add_person,
    create_keys,
    list_keys,
    remove_person,
    renew_keys,
)
from twin.security.access_control import ROLES
from twin.security.certificate_authority import (
    CertificateKeyPair,
    certificate_hosts,
    certificate_validity,
    create_authority,
    issue_certificate,
)
from twin.security.credentials import EXPIRY_WARNING_DAYS, read_credentials, read_people

HOSTS = ["rig.lab.example", "192.168.1.20", "fd00::20"]


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    folder = tmp_path / "lab"
    create_keys(folder, HOSTS)
    add_person(folder, "anna", "command", [])
    return folder


def certificate(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(path.read_bytes())


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_strict_reader_takes_the_certificates_for_their_purpose_only(lab: Path) -> None:
    """By an implementation of RFC 5280 that shares nothing with what wrote them but the library."""
    policy = PolicyBuilder().store(Store([certificate(lab / "ca.pem")]))
    rig, anna = (
        certificate(folder / "certificate.pem") for folder in (lab, lab / "people" / "anna")
    )
    names: list[x509.DNSName | x509.IPAddress] = [x509.DNSName("localhost")]
    names += [x509.DNSName(HOSTS[0]), *(x509.IPAddress(ip_address(host)) for host in HOSTS[1:])]
    for name in names:
        policy.build_server_verifier(name).verify(rig, [])
    policy.build_client_verifier().verify(anna, [])
    for wrong, leaf in ((x509.DNSName("other.example"), rig), (x509.DNSName("anna"), anna)):
        with pytest.raises(VerificationError):
            policy.build_server_verifier(wrong).verify(leaf, [])
    own = [(lab / "people/anna" / name).read_bytes() for name in ("certificate.pem", "key.pem")]
    forged = issue_certificate(CertificateKeyPair(*own), "rig", ["localhost"], local_datetime())
    leaf = x509.load_pem_x509_certificate(forged.certificate)
    with pytest.raises(VerificationError):  # a person is no authority
        policy.build_server_verifier(x509.DNSName("localhost")).verify(leaf, [anna])


def test_certificate_extensions_of_authority_and_rig(lab: Path) -> None:
    authority, rig = certificate(lab / "ca.pem"), certificate(lab / "certificate.pem")
    basic = authority.extensions.get_extension_for_class(x509.BasicConstraints)
    assert (basic.value.ca, basic.value.path_length, basic.critical) == (True, 0, True)
    usage = authority.extensions.get_extension_for_class(x509.KeyUsage).value
    assert (usage.key_cert_sign, usage.digital_signature) == (True, False)
    leaf = rig.extensions.get_extension_for_class(x509.KeyUsage).value
    assert (leaf.key_cert_sign, leaf.digital_signature) == (False, True)
    above = authority.extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value
    of = rig.extensions.get_extension_for_class(x509.AuthorityKeyIdentifier).value
    assert of.key_identifier == above.key_identifier
    assert rig.issuer == authority.subject
    now_utc = datetime.now(UTC)
    assert timedelta(3640) < authority.not_valid_after_utc - now_utc < timedelta(3660)
    assert timedelta(364) < rig.not_valid_after_utc - now_utc <= timedelta(365)


def test_serial_numbers_are_random_and_two_authorities_never_the_same(tmp_path: Path) -> None:
    for name in ("one", "two"):
        create_keys(tmp_path / name, [])
    authorities = [certificate(tmp_path / name / "ca.pem") for name in ("one", "two")]
    assert authorities[0].subject != authorities[1].subject
    pair = create_authority("x", local_datetime())
    serials = {
        x509.load_pem_x509_certificate(
            issue_certificate(pair, "a", [], local_datetime()).certificate
        ).serial_number
        for _ in range(20)
    }
    assert len(serials) == 20
    assert min(serials) > 2**100


def test_a_leaf_does_not_outlive_its_authority() -> None:
    began = local_datetime() - timedelta(days=3652 - 30)
    pair = create_authority("old", began)
    leaf = issue_certificate(pair, "a", [], local_datetime())
    ends = [certificate_validity(keys.certificate)[1] for keys in (leaf, pair)]
    assert ends[0] == ends[1]


@pytest.mark.parametrize("late", [timedelta(minutes=30), timedelta(days=1)])
def test_an_expired_authority_is_named_as_such(
    lab: Path, monkeypatch: pytest.MonkeyPatch, late: timedelta
) -> None:
    ends = certificate_validity((lab / "ca.pem").read_bytes())[1]
    monkeypatch.setattr("twin.rig.keys.local_datetime", lambda: ends + late)
    before = contents(lab)
    for change in (
        lambda: add_person(lab, "bob", "observe", []),
        lambda: renew_keys(lab, None, []),
    ):
        with pytest.raises(InputError) as error:
            change()
        assert error.value.where == str(lab / "ca.pem")
        assert f"expired on {ends:%Y-%m-%d}" in error.value.problem
        assert "keys new" in error.value.remedy
    assert contents(lab) == before


def test_private_keys_are_private_whatever_the_umask(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        create_keys(tmp_path / "lab", [])
        add_person(tmp_path / "lab", "anna", "observe", [])
        renew_keys(tmp_path / "lab", None, [])
    finally:
        os.umask(before)
    modes = {
        str(path.relative_to(tmp_path)): path.stat().st_mode & 0o777 for path in tmp_path.rglob("*")
    }
    assert {mode for name, mode in modes.items() if name.endswith("key.pem")} == {0o600}
    folders = {mode for name, mode in modes.items() if (tmp_path / name).is_dir()}
    assert folders == {0o700}


def test_nothing_is_overwritten_and_a_name_is_given_once(lab: Path) -> None:
    before = contents(lab)
    for again in (
        lambda: create_keys(lab, []),
        lambda: add_person(lab, "anna", "observe", []),
        lambda: add_person(lab, "Anna", "observe", []),
        lambda: add_person(lab, "rig", "observe", []),
        lambda: add_person(lab, "bob", "router", ["no host"]),
        lambda: add_person(lab, "bob", "router", []),
        lambda: add_person(lab, "bob", "observe", ["rig.lab.example"]),  # it would be another rig
        lambda: renew_keys(lab, "anna", ["rig.lab.example"]),
        lambda: create_keys(lab.parent / "new", ["a b"]),
        lambda: remove_person(lab, "bob"),
        lambda: renew_keys(lab, "bob", []),
        lambda: renew_keys(lab, "/x", []),
        lambda: renew_keys(lab, "../anna", []),
        lambda: renew_keys(lab, "*", []),
    ):
        with pytest.raises(InputError):
            again()
    assert contents(lab) == before
    shutil.rmtree(lab / "people")  # as one does that was handed over
    remove_person(lab, "anna")
    with raises_input_error(key="NAME", value="anna", remedy=f"keys renew {lab} anna"):
        add_person(lab, "anna", "observe", [])
    add_person(lab, "anna-2", "observe", [])
    renew_keys(lab, "anna-2", [])


def test_a_removed_person_has_no_role_and_the_others_keep_theirs(lab: Path) -> None:
    add_person(lab, "ann", "observe", [])
    text = (lab / "access.toml").read_text()
    (lab / "access.toml").write_text(text + '"bob"   = "record"  # until May\n')
    remove_person(lab, "anna")
    assert read_people(lab) == {"ann": "observe", "bob": "record"}
    assert "# until May" in (lab / "access.toml").read_text()
    remove_person(lab, "bob")
    assert read_people(lab) == {"ann": "observe"}


def test_a_list_written_otherwise_by_hand_is_left_alone(lab: Path) -> None:
    path = lab / "access.toml"
    path.write_text('people = {anna = "command"}\n')
    for change in (
        lambda: add_person(lab, "bob", "observe", []),
        lambda: remove_person(lab, "anna"),
    ):
        with raises_input_error(where=path):
            change()
    assert path.read_text() == 'people = {anna = "command"}\n'
    assert not (lab / "people" / "bob").exists()


def test_renewed_keys_replace_the_old_for_the_same_hosts_and_authority(lab: Path) -> None:
    files = ("certificate.pem", "key.pem", "ca.pem")
    for folder, name in ((lab, "rig"), (lab / "people" / "anna", "anna")):
        old = {file: (folder / file).read_bytes() for file in files}
        renew_keys(lab, None if folder == lab else name, [])
        new = {file: (folder / file).read_bytes() for file in files}
        assert {file for file in files if new[file] == old[file]} == {"ca.pem"}
        hosts = [certificate_hosts(keys["certificate.pem"]) for keys in (old, new)]
        assert hosts[0] == hosts[1]
        assert read_credentials(folder).name == name
    renew_keys(lab, None, ["new.example"])
    hosts_now = certificate_hosts((lab / "certificate.pem").read_bytes())
    assert {"new.example", "localhost"} <= set(hosts_now)
    assert HOSTS[0] not in hosts_now
    assert len(list((lab / "issued").glob("anna.*.pem"))) == 2
    add_person(lab, "relay", "router", ["relay.example"])
    renew_keys(lab, "relay", [])
    assert certificate_hosts((lab / "people/relay/certificate.pem").read_bytes()) == [
        "relay.example"
    ]


def test_the_roles_are_the_same_everywhere(lab: Path) -> None:
    assert tuple(keys.Role) == ROLES
    for role in ROLES:
        (lab / "access.toml").write_text(f'[people]\nanna = "{role}"\n')
        assert read_people(lab) == {"anna": role}


def test_without_the_authoritys_key_nothing_is_issued(lab: Path) -> None:
    key = lab / "ca.key.pem"
    away = key.rename(lab.parent / "safe.pem")
    assert read_credentials(lab).name == "rig"
    with raises_input_error(where=key, problem=os.strerror(errno.ENOENT)):
        add_person(lab, "bob", "observe", [])
    for wrong in (b"x", (lab / "key.pem").read_bytes()):
        key.write_bytes(wrong)
        with pytest.raises(InputError, match="restore"):
            add_person(lab, "bob", "observe", [])
    assert "bob" not in read_people(lab)
    away.replace(key)
    add_person(lab, "bob", "observe", [])


def test_the_list_says_who_may_what_and_until_when(
    lab: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    add_person(lab, "bob", "observe", [])
    remove_person(lab, "bob")
    capsys.readouterr()
    list_keys(lab)
    year = local_datetime() + timedelta(days=365)
    rows = {row.split()[0]: row for row in capsys.readouterr().out.splitlines()}
    assert re.search(rf"command +{year:%Y}", rows["anna"])
    assert re.search(rf"none +{year:%Y}", rows["bob"])
    assert {"(authority)", "(rig)"} <= rows.keys()
    for later, says in ((366 - EXPIRY_WARNING_DAYS, "days left"), (400, "EXPIRED")):
        at = local_datetime() + timedelta(days=later)
        monkeypatch.setattr("twin.rig.keys.local_datetime", lambda at=at: at)
        list_keys(lab)
        assert says in capsys.readouterr().out
        monkeypatch.undo()


def test_keys_that_expire_soon_say_so(
    lab: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    capsys.readouterr()
    assert options.read_keys_option(None) is None
    assert options.read_keys_option(lab, rig=True) is not None
    assert capsys.readouterr().out == ""
    monkeypatch.setattr(
        "twin.security.credentials.local_datetime", lambda: local_datetime() + timedelta(days=360)
    )
    options.read_keys_option(lab / "people" / "anna")
    assert "expires in 4 days" in capsys.readouterr().out
    with raises_input_error(key="--keys", value=str(lab / "people" / "anna"), remedy="access.toml"):
        options.read_keys_option(lab / "people" / "anna", rig=True)


def test_the_commands(tmp_path: Path) -> None:
    app = typer.Typer()
    app.add_typer(keys.keys_app, name="keys")
    folder = str(tmp_path / "lab")

    def run(*words: str) -> str:
        result = CliRunner().invoke(app, ["keys", *words], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return result.output

    run("new", folder, "--host", "rig.example", "--host", "10.0.0.9")
    run("add", folder, "anna", "--role", "observe")
    run("renew", folder, "anna")
    assert "https://rig.example:7480/#" in run(
        "code", folder, "anna", "--page", "https://rig.example:7480"
    )
    run("list", folder)
    run("remove", folder, "anna")
    assert CliRunner().invoke(app, ["keys", "add", folder, "bob", "--role", "king"]).exit_code == 2
    assert read_people(tmp_path / "lab") == {}


def test_the_commands_of_the_page_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    app = typer.Typer()
    app.add_typer(keys.keys_app, name="keys")
    page = (Path(keys.__file__).parents[1] / "security" / "KEYS.md").read_text()
    lines = [line for line in page.splitlines() if line.startswith("shaketwin keys")]
    assert len(lines) == 7
    monkeypatch.chdir(tmp_path)
    for line in lines:
        words = shlex.split(line.partition(">")[0], comments=True)
        result = CliRunner().invoke(app, words[1:], catch_exceptions=False)
        assert result.exit_code == 0, result.output


def test_a_fault_is_one_message_and_exit_code_2(tmp_path: Path) -> None:
    program = Path(sys.executable).parent / "shaketwin"
    result = subprocess.run(
        [str(program), "keys", "list", str(tmp_path / "nowhere")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.returncode, result.stdout) == (2, "")
    assert "access.toml: cannot read: No such file" in result.stderr
    assert "Traceback" not in result.stderr
