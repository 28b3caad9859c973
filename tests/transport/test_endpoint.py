"""Endpoints of the bus: what is allowed, and the fields of an error."""

import socket

import pytest

from table_io.errors import InputError
from twin.transport.endpoint import check_can_listen, check_endpoint, split_host_port

LOOPBACK = "tcp/127.0.0.1:7447"


@pytest.mark.parametrize(
    ("endpoint", "has_keys", "address"),
    [
        (LOOPBACK, False, ("127.0.0.1", 7447)),
        ("tcp/[::1]:1", False, ("::1", 1)),
        ("tls/rig.lab:7447", True, ("rig.lab", 7447)),
    ],
)
def test_an_allowed_endpoint_has_a_host_and_a_port(
    endpoint: str, has_keys: bool, address: tuple[str, int]
) -> None:
    check_endpoint("simulated", endpoint, has_keys)
    assert split_host_port(endpoint) == address


@pytest.mark.parametrize(
    ("endpoint", "has_keys", "solution"),
    [
        ("127.0.0.1:7447", False, "tcp/127.0.0.1:7447"),
        ("tcp/127.0.0.1:70000", False, "tcp/<host>:<port>"),
        ("tls/rig.lab:7447", False, "--keys FOLDER"),
        ("tcp/127.0.0.1:7447", True, "tls/"),
        ("tcp/192.168.1.5:7447", False, "this machine only"),
    ],
)
def test_an_endpoint_that_is_not_allowed_is_the_value(
    endpoint: str, has_keys: bool, solution: str
) -> None:
    with pytest.raises(InputError) as error:
        check_endpoint("simulated", endpoint, has_keys)
    assert (error.value.key, error.value.value) == ("endpoint", endpoint)
    assert solution in error.value.allowed + error.value.remedy


def test_a_rig_name_that_is_no_key_is_the_value() -> None:
    with pytest.raises(InputError) as error:
        check_endpoint("rig/*", LOOPBACK, False)
    assert (error.value.key, error.value.value) == ("rig", "rig/*")
    assert "letters" in error.value.allowed


def test_a_used_port_is_the_value() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(InputError) as error:
            check_can_listen("simulated", endpoint, False)
    assert (error.value.key, error.value.value) == ("endpoint", endpoint)
    assert "another port" in error.value.remedy
