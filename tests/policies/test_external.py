"""Policies behind a server: what comes through the bridge, and what is said when it breaks."""

from __future__ import annotations

import copy
import dataclasses
import multiprocessing
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time

import cloudpickle
import numpy as np
import pytest
import torch
from observations import INSTRUCTIONS, observed, oft_policy
from policy_servers import ServerProcess, serving, talking
from torchrl.envs.utils import ExplorationType, set_exploration_type

from worldenv_trl import keys
from worldenv_trl.objectives import LOOPLoss
from worldenv_trl.policies import ExternalPolicy, OFTPolicy, ServedPolicy, laplace_actor, scale_bounds
from worldenv_trl.policies.bridge import (
    ActionUnits,
    Description,
    PolicyServer,
    receive_message,
    send_message,
    socket_address,
)

CAMERAS = ("agentview", "wrist")
TOLD = Description("still", ("agentview",), image_size=64, chunk_length=8, proprio="commanded")


def still(images, state, instructions):
    return np.zeros((len(state), 8, 7), np.float32)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    policy = oft_policy(cameras=CAMERAS)
    policy.fit_statistics(torch.randn(50, 7), torch.randn(50, 7) * 0.3)
    return policy.save_pretrained(tmp_path_factory.mktemp("policy"))


@pytest.fixture(scope="module")
def server(checkpoint):
    with ServerProcess(checkpoint) as process:
        yield process


@pytest.fixture
def local(checkpoint):
    return OFTPolicy.from_pretrained(checkpoint).eval()


def test_actions_through_the_bridge_are_those_of_the_served_policy_bit_for_bit(server, local):
    external = ExternalPolicy.connect(server.address)
    assert (external.cameras, external.image_size, external.chunk_length) == (CAMERAS, 64, 8)
    assert external.proprio == local.proprio and external.instructions == INSTRUCTIONS
    assert torch.equal(external.action_range, local.action_range)
    td = observed(CAMERAS)
    for rows in (slice(None), slice(2, 3)):
        with torch.no_grad():
            expected = local(td[rows].copy())
        found = external(td[rows].copy())
        assert torch.equal(found[keys.LOC], expected[keys.LOC])
        assert torch.equal(found[keys.LOG_SCALE], expected[keys.LOG_SCALE])


def test_exploration_draws_the_same_chunks_and_scores_them_alike(server, local):
    drawn = []
    for policy in (local, ExternalPolicy.connect(server.address)):
        torch.manual_seed(3)
        actor = laplace_actor(policy, log_scale_bounds=scale_bounds(policy))
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            drawn.append(actor(observed(CAMERAS)))
    assert torch.equal(drawn[0][keys.CHUNK], drawn[1][keys.CHUNK])
    assert torch.equal(drawn[0][keys.LOG_PROBS], drawn[1][keys.LOG_PROBS])
    assert not torch.equal(drawn[1][keys.CHUNK], drawn[1][keys.LOC])


def test_parallel_clients_get_their_own_answers(server, local):
    """Some with connections of their own, some through one policy; each asks for another row, again and again."""
    td, shared = observed(CAMERAS), ExternalPolicy.connect(server.address)
    with torch.no_grad():
        expected = [local(td[row : row + 1].copy())[keys.LOC] for row in range(6)]
    wrong: list = []

    def client(row: int) -> None:
        try:
            policy = shared if row % 2 else copy.deepcopy(shared)
            for _ in range(10):
                if not torch.equal(policy(td[row : row + 1].copy())[keys.LOC], expected[row]):
                    wrong.append(row)
        except Exception as error:
            wrong.append(error)

    threads = [threading.Thread(target=client, args=(row,)) for row in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert not wrong and not any(thread.is_alive() for thread in threads)


def _ask_in_a_child(policy, answers):
    answers.put(policy(observed())[keys.LOC].shape)


def test_a_copy_and_a_forked_process_have_connections_of_their_own():
    """Two askers on one connection would mix their answers."""
    said: list[str] = []
    fork = multiprocessing.get_context("fork")
    answers = fork.Queue()
    with serving(PolicyServer(still, TOLD, say=said.append)) as address:
        external = ExternalPolicy.connect(address)
        clients = []
        for ask in (
            lambda: external(observed()),
            lambda: external(observed()),
            lambda: cloudpickle.loads(cloudpickle.dumps(external))(observed()),
            lambda: copy.deepcopy(external)(observed()),
        ):
            ask()
            clients.append(sum(line.endswith("is here") for line in said))
        child = fork.Process(target=_ask_in_a_child, args=(external, answers))
        child.start()
        assert answers.get(timeout=60) == (6, 8, 7)
        child.join(20)
        clients.append(sum(line.endswith("is here") for line in said))
        external(observed())
        clients.append(sum(line.endswith("is here") for line in said))
    first = clients[0]
    assert clients == [first, first, first + 1, first + 2, first + 3, first + 3]


def test_what_it_saves_names_the_server_and_holds_it_against_what_was_said(server, tmp_path):
    external = ExternalPolicy.connect(server.address, timeout=7.5)
    loaded = ExternalPolicy.from_pretrained(external.save_pretrained(tmp_path))
    assert loaded.config == external.config and loaded.connection.timeout == 7.5
    td = observed(CAMERAS)
    assert torch.equal(loaded(td.copy())[keys.LOC], external(td.copy())[keys.LOC])
    told = dataclasses.replace(external.config.description, digest="of other weights")
    other = ExternalPolicy(dataclasses.replace(external.config, description=told)).save_pretrained(tmp_path / "other")
    with pytest.raises(
        RuntimeError, match=r"serves another policy than before, its digest is .* was 'of other weights'"
    ):
        ExternalPolicy.from_pretrained(other)


def test_a_server_that_was_killed_is_named_and_one_started_again_is_found(checkpoint, tmp_path):
    address, td = f"unix:{tmp_path}/policy.sock", observed(CAMERAS)
    with ServerProcess(checkpoint, address) as process:
        external = ExternalPolicy.connect(address)
        before = external(td.copy())[keys.LOC]
        process.end(signal.SIGKILL)
        with pytest.raises(ConnectionError, match=f"no policy server answers at {address} .*recipes/serve.py"):
            external(td.copy())
    with ServerProcess(checkpoint, address) as process:
        assert torch.equal(external(td.copy())[keys.LOC], before)
        process.end(signal.SIGKILL)
        with ServerProcess(checkpoint, address):  # between two questions: nobody notices
            assert torch.equal(external(td.copy())[keys.LOC], before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_the_server_at_once_with_clients_connected(checkpoint, tmp_path, number):
    path = tmp_path / "policy.sock"
    with ServerProcess(checkpoint, f"unix:{path}") as process:
        clients = [ExternalPolicy.connect(process.address) for _ in range(3)]
        started = time.monotonic()
        said = process.end(number)
        assert time.monotonic() - started < 10
        assert process.process.returncode == 0 and "ended\n" in said and "Traceback" not in said
        assert not path.exists()
        with pytest.raises(ConnectionError):
            clients[0](observed(CAMERAS))


def test_ctrl_c_ends_a_server_in_the_middle_of_an_answer_and_its_whole_group_of_processes(tmp_path):
    script = """
import time, numpy as np
from worldenv_trl.policies.bridge import Description, serve
def slow(images, state, instructions):
    print("asked", flush=True)
    time.sleep(60)
serve(slow, Description("slow", ("agentview",), 64, 8, "commanded"), "127.0.0.1:0")
"""
    command = [sys.executable, "-c", script]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as process:
        external = ExternalPolicy.connect(process.stdout.readline().split(" at ")[1].split(";")[0])
        failed = []

        def ask():
            try:
                external(observed())
            except ConnectionError as error:
                failed.append(str(error))

        thread = threading.Thread(target=ask)
        thread.start()
        while "asked" not in process.stdout.readline():
            pass
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(10) == 0
        thread.join(10)
    assert len(failed) == 1 and "no policy server answers" in failed[0]
    with pytest.raises(ProcessLookupError):  # nobody of its group is left
        os.killpg(process.pid, 0)


def test_a_slow_server_is_named_and_its_late_answer_is_not_taken_for_the_next_one():
    first = threading.Event()

    def slow_once(images, state, instructions):
        if not first.is_set():
            first.set()
            time.sleep(1.0)
            return np.ones((len(state), 8, 7), np.float32)
        return still(images, state, instructions)

    with serving(PolicyServer(slow_once, TOLD)) as address:
        external = ExternalPolicy.connect(address, timeout=0.3)
        started = time.monotonic()
        with pytest.raises(TimeoutError, match=f"server at {address} did not answer within 0.3 s: .*timeout="):
            external(observed())
        assert time.monotonic() - started < 0.9  # asked once
        external.connection.timeout = 20.0
        assert not external(observed())[keys.LOC].any()


def test_a_server_that_accepts_and_says_nothing_is_a_slow_one():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(TimeoutError, match=f"{address} did not answer within 0.2 s"):
            ExternalPolicy.connect(address, timeout=0.2)


@pytest.mark.parametrize(
    ("sent", "message"),
    [
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "is no policy server: .*'HTTP/1.1'.*Name the address"),
        (bytes(range(200, 250)), "is no policy server"),
        (b"WEPB" + struct.pack(">HIQ", 2, 1, 1) + b"xx", "it speaks version 2 .*, this side speaks 1: copy"),
        (b"WEPB" + struct.pack(">HIQ", 1, 30, 10) + b'{"kind":"hello","policy":true}' + struct.pack("<Q", 2) + b"{}",
         "its description is wrong"),
    ],
)  # fmt: skip
def test_what_is_no_policy_server_of_this_version_is_named(sent, message):
    def answer(connection):
        receive_message(connection)
        connection.sendall(sent)
        connection.recv(1)

    with talking(answer) as address, pytest.raises(RuntimeError, match=f"{address}.*{message}"):
        ExternalPolicy.connect(address, timeout=10)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((6, 4, 7), np.float32), r"actions float32 \[6, 8, 7\], all finite, got float32 \[6, 4, 7\]: mend"),
        (np.zeros((6, 8, 7), np.float64), r"got float64 \[6, 8, 7\]: mend"),
        (np.full((6, 8, 7), np.inf, np.float32), r"got float32 \[6, 8, 7\], not all finite: mend"),
        (None, "got nothing: mend"),
    ],
)
def test_actions_of_another_shape_are_named(actions, message):
    def answer(connection):
        receive_message(connection)
        send_message(connection, {"kind": "hello", "policy": dataclasses.asdict(TOLD)})
        header, _ = receive_message(connection)
        send_message(
            connection, {"kind": "actions", "id": header["id"]}, {} if actions is None else {"actions": actions}
        )
        connection.recv(1)

    with (
        talking(answer) as address,
        pytest.raises(RuntimeError, match=f"server at {address} must answer with.*{message}"),
    ):
        ExternalPolicy.connect(address)(observed())


def test_what_fails_in_the_server_is_told_in_one_line():
    def broken(images, state, instructions):
        raise OSError("the weights\nare gone")

    with (
        serving(PolicyServer(broken, TOLD)) as address,
        pytest.raises(RuntimeError, match=f"{address} could not answer: OSError: the weights are gone"),
    ):
        ExternalPolicy.connect(address)(observed())


def test_nobody_at_an_address_and_no_address():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        free = listener.getsockname()[1]
    with pytest.raises(ConnectionError, match=f"no policy server answers at 127.0.0.1:{free} .*Connection refused"):
        ExternalPolicy.connect(f"127.0.0.1:{free}")
    with pytest.raises(ConnectionError, match=r"no policy server answers at unix:/nowhere/policy.sock \(No such file"):
        ExternalPolicy.connect("unix:/nowhere/policy.sock")
    with pytest.raises(ValueError, match="an address is host:port or unix:/path, got 'localhost'"):
        ExternalPolicy.connect("localhost")
    with pytest.raises(ValueError, match="timeout must be a positive number of seconds, got 0"):
        ExternalPolicy.connect("localhost:1", timeout=0)


def test_it_says_that_it_cannot_learn_whoever_asks(server):
    external = ExternalPolicy.connect(server.address)
    actor = laplace_actor(external)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        batch = actor(observed(CAMERAS))
    batch[keys.ADVANTAGE] = torch.ones(6, 1)
    batch[keys.STEP_MASK] = torch.ones(6, 8, dtype=torch.bool)
    for ask in (
        lambda: external.post_training_parameters(4),
        lambda: external.fit_statistics(torch.zeros(2, 7), torch.zeros(2, 7)),
        external.scale_parameters,
        lambda: actor.log_prob(batch),
        lambda: LOOPLoss(actor, functional=False)(batch),
    ):
        with pytest.raises(
            RuntimeError, match=f"served at {server.address} can be evaluated .* not trained: its weights"
        ):
            ask()


def test_actions_in_other_units_come_out_in_ours():
    """OpenVLA's gripper (1 open, 0 closed), steps of 2 cm and 0.1 rad; a server that says nothing of its noise."""
    raw = np.random.default_rng(0).uniform(-1, 1, (6, 8, 7)).astype(np.float32)
    raw[..., 6] = np.random.default_rng(1).uniform(0, 1, (6, 8))
    units = ActionUnits(position=0.02, rotation=0.1, gripper_open=1.0, gripper_closed=0.0)
    told = dataclasses.replace(TOLD, units=units, action_range=(0.5, 0.5, 0.5, 1.0, 1.0, 1.0, 0.5))
    with serving(PolicyServer(lambda *_: raw, told)) as address:
        external = ExternalPolicy.connect(address)
        out = external(observed())
    expected = raw.astype(np.float64)
    expected[..., :3] *= 0.02 / 0.05  # metres over the metres of an action of ours
    expected[..., 3:6] *= 0.1 / 0.5
    expected[..., 6] = 1 - 2 * expected[..., 6]
    torch.testing.assert_close(out[keys.LOC].double(), torch.from_numpy(expected), atol=1e-6, rtol=0)
    torch.testing.assert_close(external.action_range, torch.tensor([0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 1.0]))
    # Its noise is no more than the floor of exploration.
    low, high = scale_bounds(external)
    actor = laplace_actor(external, log_scale_bounds=(low, high))
    assert (out[keys.LOG_SCALE] <= torch.tensor(low)).all() and actor.policy is external


def test_the_noise_of_a_server_in_other_units_is_its_own():
    told = dataclasses.replace(TOLD, units=ActionUnits(position=0.1, gripper_open=1.0, gripper_closed=0.0))

    def noisy(images, state, instructions):
        return still(images, state, instructions), np.full((len(state), 8, 7), np.log(0.01), np.float32)

    with serving(PolicyServer(noisy, told)) as address:
        scale = ExternalPolicy.connect(address)(observed())[keys.LOG_SCALE].exp()
    torch.testing.assert_close(scale[0, 0], torch.tensor([0.02, 0.02, 0.02, 0.01, 0.01, 0.01, 0.02]))


def test_a_policy_of_another_rate_is_refused():
    told = dataclasses.replace(TOLD, units=ActionUnits(control_hz=5))
    with serving(PolicyServer(still, told)) as address, pytest.raises(ValueError, match="acts at 5 Hz, the envs at 20"):
        ExternalPolicy.connect(address)


def test_a_vision_language_policy_is_served_too(tmp_path):
    from hf_models import hf_policy

    policy = hf_policy().eval()
    policy.save_pretrained(tmp_path)
    with ServerProcess(tmp_path) as process:
        external = ExternalPolicy.connect(process.address, timeout=120)
        with torch.no_grad():
            expected = policy(observed(policy.cameras, policy.image_size))
        found = external(observed(policy.cameras, policy.image_size))
    assert torch.equal(found[keys.LOC], expected[keys.LOC])


def test_the_server_refuses_what_it_cannot_serve_in_one_line(tmp_path):
    with ServerProcess(tmp_path / "nowhere") as process:
        assert process.process.returncode == 1
    assert process.said.startswith("error: no OFTPolicy checkpoint at") and process.said.count("\n") == 1


def test_a_served_policy_says_what_it_is():
    policy = oft_policy()
    told = ServedPolicy(policy, name="mine").description
    assert (told.name, told.cameras, told.units) == ("mine", policy.cameras, ActionUnits())
    assert socket_address("[::1]:80") == (socket.AF_INET6, ("::1", 80))
