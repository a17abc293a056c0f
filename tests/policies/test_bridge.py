"""The bridge's messages and its server, apart from any policy."""

from __future__ import annotations

import ast
import dataclasses
import json
import re
import shutil
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from policy_servers import serving, talking

from worldenv_trl.policies import bridge
from worldenv_trl.policies.bridge import (
    ActionUnits,
    Description,
    PolicyServer,
    ProtocolError,
    VersionError,
    receive_message,
    send_message,
    socket_address,
)

FOLDER = Path(bridge.__file__).parent
TOLD = Description("counting", ("agentview",), image_size=16, chunk_length=2, proprio="measured")


def counting(images, state, instructions):
    """Actions that tell which row they are for."""
    return np.arange(len(state), dtype=np.float32)[:, None, None] + np.zeros((1, 2, 7), np.float32)


def request(rows: int = 3, **changes):
    arrays = {"image.agentview": np.zeros((rows, 3, 16, 16), np.uint8), "state": np.zeros((rows, 7), np.float32)}
    return {"kind": "act", "id": 5, "instructions": rows * ["go"]}, arrays | changes


def ask(address: str, header, arrays=None):
    with socket.create_connection(socket_address(address)[1], 10) as connection:
        send_message(connection, header, arrays)
        return receive_message(connection, deadline=time.monotonic() + 10)


def test_a_message_comes_out_as_it_went_in():
    near, far = socket.socketpair()
    arrays = {
        "image": np.random.default_rng(0).integers(0, 256, (2, 3, 4, 4), np.uint8).transpose(0, 1, 3, 2),
        "state": np.array([[np.nextafter(np.float32(1), np.float32(2)), -0.0]], np.float32),
    }
    with near, far:
        send_message(near, {"kind": "act", "texts": ["öffne die Schublade"]}, arrays)
        header, found = receive_message(far)
        near.close()
        with pytest.raises(EOFError):
            receive_message(far)
    assert header == {"kind": "act", "texts": ["öffne die Schublade"]} and found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype and found[name].tobytes() == array.tobytes()


def test_a_message_has_the_bytes_that_the_readme_describes():
    """Written out by hand, as another language would."""
    near, far = socket.socketpair()
    data = json.dumps({"state": {"dtype": "F32", "shape": [1, 2], "data_offsets": [0, 8]}}).encode()
    data = struct.pack("<Q", len(data)) + data + struct.pack("<2f", 1.5, -2.0)
    header = b'{"kind": "act"}'
    with near, far:
        near.sendall(b"WEPB" + struct.pack(">HIQ", 1, len(header), len(data)) + header + data)
        assert receive_message(far)[0] == {"kind": "act"}
        near.sendall(b"WEPB" + struct.pack(">HIQ", 1, len(header), len(data)) + header + data)
        np.testing.assert_array_equal(receive_message(far)[1]["state"], np.array([[1.5, -2.0]], np.float32))


@pytest.mark.parametrize(
    ("sent", "error"),
    [
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", ProtocolError),
        (b"WEPB" + struct.pack(">HIQ", 2, 1, 1) + b"xx", VersionError),
        (b"WEPB" + struct.pack(">HIQ", 1, 1, 1 << 60), ProtocolError),
        (b"WEPB" + struct.pack(">HIQ", 1, 2, 3) + b"{}\x00\x00\x00", ProtocolError),
        (b"WEPB" + struct.pack(">HIQ", 1, 9, 10) + b'["kind"] ' + struct.pack("<Q", 2) + b"{}", ProtocolError),
        (b"WEPB" + struct.pack(">HIQ", 1, 9000, 0) + b"[" * 9000, ProtocolError),
        (b"WEPB\x00\x01", ConnectionError),
    ],
)  # fmt: skip
def test_what_is_no_message_is_refused(sent, error):
    near, far = socket.socketpair()
    with near, far:
        near.sendall(sent)
        near.shutdown(socket.SHUT_WR)
        with pytest.raises(error):
            receive_message(far, deadline=time.monotonic() + 5)


def test_a_message_that_drips_in_is_not_waited_for_beyond_the_deadline():
    def drip(connection):
        for _ in range(100):
            connection.sendall(b"W")
            time.sleep(0.05)

    with talking(drip) as address, socket.create_connection(socket_address(address)[1]) as connection:
        started = time.monotonic()
        with pytest.raises(TimeoutError):
            receive_message(connection, deadline=started + 0.4)
        assert time.monotonic() - started < 2


def test_a_description_passes_through_json_and_an_unknown_field_is_left_out():
    told = dataclasses.replace(
        TOLD,
        units=ActionUnits(gripper_open=1, gripper_closed=0),
        action_range=7 * (0.1 + 0.2,),
        instructions=("a", "b"),
    )
    fields = json.loads(json.dumps(dataclasses.asdict(told) | {"of a later version": 1}))
    assert Description.from_dict(fields) == told


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": "agentview"}, "cameras cannot be 'agentview'"),
        ({"cameras": []}, "at least one camera"),
        ({"image_size": "64"}, "image_size cannot be '64'"),
        ({"chunk_length": 0}, "at least 1, got 16 and 0"),
        ({"proprio": "felt"}, "'commanded' or 'measured', got 'felt'"),
        ({"action_range": [1.0]}, "7 positive numbers"),
        ({"action_range": [None] * 7}, "NoneType"),
        ({"units": {"gripper_open": 1.0}}, "must differ, both are 1.0"),
        ({"units": {"position": -1}}, "finite positive number, got -1.0"),
        ({"units": {"furlongs": 1}}, "furlongs"),
    ],
)
def test_what_describes_no_policy_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Description.from_dict(dataclasses.asdict(TOLD) | change)


def test_a_server_says_in_one_line_what_is_wrong_with_a_request_and_lives_on():
    server = PolicyServer(counting, TOLD)
    with serving(server) as address:
        for header, arrays, message in (
            (*request(state=np.zeros((2, 7), np.float32)), "state must be float32 [3, 7], got float32 [2, 7]"),
            (*request(**{"image.agentview": np.zeros((3, 16, 16, 3), np.uint8)}), "must be uint8 [3, 3, 16, 16], got"),
            ({"kind": "act", "id": 5, "instructions": "go"}, {}, "instructions must be a list of texts"),
            ({"kind": "dance", "id": 5}, {}, "of the kind hello or act, got 'dance'"),
        ):
            answer, found = ask(address, header, arrays)
            assert answer["kind"] == "error" and message in answer["message"] and answer["id"] == 5 and not found
        with socket.create_connection(socket_address(address)[1]) as connection:
            connection.sendall(b"GET / HTTP/1.1\r\n\r\n      ")
            assert receive_message(connection)[0]["kind"] == "error"
            assert not connection.recv(1)  # cut off
        answer, found = ask(address, *request())
        assert answer == {"kind": "actions", "id": 5}
        np.testing.assert_array_equal(found["actions"][:, 1, 6], [0, 1, 2])


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda *_: np.zeros((3, 4, 7)), "the policy's actions must be [3, 2, 7] finite numbers, got [3, 4, 7]"),
        (lambda *_: np.full((3, 2, 7), np.nan), "got [3, 2, 7], some not finite"),
        (lambda *_: (np.zeros((3, 2, 7)), np.zeros(7)), "the policy's log_scale must be"),
        (lambda *_: {}["weights"], "KeyError: 'weights'"),
    ],
)
def test_what_a_policy_does_wrong_is_told_to_the_client(act, message):
    with serving(PolicyServer(act, TOLD)) as address:
        assert message in ask(address, *request())[0]["message"]


def test_an_address_that_is_taken_or_none_is_refused_and_what_a_killed_server_left_is_not(tmp_path):
    path = tmp_path / "policy.sock"
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(str(path))
    with serving(PolicyServer(counting, TOLD, f"unix:{path}")) as address:
        assert path.stat().st_mode & 0o77 == 0
        with pytest.raises(ValueError, match=f"cannot listen at {address} .*choose another address"):
            PolicyServer(counting, TOLD, address)
    assert not path.exists()
    with serving(PolicyServer(counting, TOLD)) as address, pytest.raises(ValueError, match="cannot listen at"):
        PolicyServer(counting, TOLD, address)
    for wrong in ("8765", "localhost:", "localhost:http", "localhost:99999", "unix:"):
        with pytest.raises(ValueError, match="an address is host:port or unix:/path"):
            PolicyServer(counting, TOLD, wrong)


def test_the_folder_serves_where_it_is_copied_to_without_this_package_and_without_torch(tmp_path):
    shutil.copytree(FOLDER, tmp_path / "bridge", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "adapter.py").write_text("""
import sys
sys.modules.update(dict.fromkeys(("torch", "tensordict", "torchrl", "worldenv_trl")))  # importing them fails
import numpy as np
from bridge import Description, serve

def act(images, state, instructions):
    return np.repeat(state[:, None], 2, 1)

serve(act, Description("copied", ("agentview",), 16, 2, "measured"), "127.0.0.1:0")
""")
    with subprocess.Popen(
        [sys.executable, "adapter.py"], cwd=tmp_path, env={"PYTHONPATH": ""}, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            address = process.stdout.readline().split(" at ")[1].split(";")[0]
            state = np.arange(21, dtype=np.float32).reshape(3, 7)
            np.testing.assert_array_equal(ask(address, *request(state=state))[1]["actions"][:, 1], state)
        finally:
            process.terminate()
        assert process.wait(10) == 0


def test_the_folder_is_python_3_10():
    files = list(FOLDER.glob("*.py"))
    assert len(files) == 4
    for file in files:
        ast.parse(file.read_text(), feature_version=(3, 10))


@pytest.mark.parametrize("package", ["openpi", "lerobot"])
def test_the_adapters_of_the_readme_hand_over_what_the_packages_take_and_the_bridge_wants(package, monkeypatch):
    """With stand-ins for the packages, which are not installed: shapes and types alone, and which way round."""
    blocks = re.findall(r"```python\n(.*?)```", (FOLDER.parent / "README.md").read_text(), re.S)
    (code,) = [block for block in blocks if f"from {package}." in block]
    seen, handed = [], []

    class Policy:
        config = None

        def infer(self, observation):
            seen.append(observation)
            return {"actions": np.zeros((10, 32))}

        def predict_action_chunk(self, observation):
            seen.append(observation)
            return torch.zeros(3, 50, 7)

        from_pretrained = classmethod(lambda cls, path: cls())
        to = eval = lambda self, *_: self

    fakes = {
        "bridge": {"Description": Description, "serve": lambda *given: handed.extend(given)},
        "openpi.policies": {"policy_config": SimpleNamespace(create_trained_policy=lambda *_: Policy())},
        "openpi.training": {"config": SimpleNamespace(get_config=str)},
        "lerobot.policies.factory": {
            "get_policy_class": lambda name: Policy,
            "make_pre_post_processors": lambda *_, **__: (dict, lambda action: action),
        },
    }
    for name, contents in fakes.items():
        module = ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    exec(code, {})
    act, told, _ = handed
    size = told.image_size
    rng = np.random.default_rng(0)
    images = {camera: rng.integers(0, 256, (3, 3, size, size), np.uint8) for camera in told.cameras}
    state = rng.uniform(0, 1, (3, 7)).astype(np.float32)
    with serving(PolicyServer(act, told)) as address:
        arrays = {f"image.{camera}": image for camera, image in images.items()} | {"state": state}
        answer, found = ask(address, {"kind": "act", "id": 1, "instructions": ["a", "b", "c"]}, arrays)
    assert answer["kind"] == "actions" and found["actions"].shape == (3, told.chunk_length, 7)
    first = {name: np.asarray(value) for name, value in seen[0].items()}
    if package == "openpi":
        assert len(seen) == 3 and seen[2]["prompt"] == "c"
        np.testing.assert_array_equal(first["observation/image"], images["agentview"][0].transpose(1, 2, 0)[:, ::-1])
        found_state = first["observation/state"]
    else:
        assert seen[0]["task"] == ["a", "b", "c"]
        np.testing.assert_allclose(first["observation.images.image2"], images["wrist"][..., ::-1] / 255, atol=1e-6)
        found_state = first["observation.state"][0]
    expected = [*state[0, :6], 0.04 * state[0, 6], -0.04 * state[0, 6]]
    assert found_state.dtype == np.float32
    np.testing.assert_allclose(found_state, expected, atol=1e-6)
