"""FAST's codec against its definition, what it does with nonsense, and its files."""

from __future__ import annotations

import copy
import json
import math

import pytest
import torch

pytest.importorskip("transformers")

from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
from torch import Tensor

from worldenv_trl.policies import FASTActionTokenizer


def smooth(count: int = 200, length: int = 8) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return (0.2 * torch.randn(count, length, 7, generator=generator)).cumsum(1).clamp(-1.5, 1.5)


def cosine(chunk: Tensor) -> list[list[float]]:
    """The orthonormal DCT-II of [H, 7], a sum at a time."""
    length = len(chunk)
    out = []
    for k in range(length):
        gain = math.sqrt((1 if k == 0 else 2) / length)
        terms = [math.cos(math.pi * (t + 0.5) * k / length) for t in range(length)]
        out.append([gain * sum(c * chunk[t, d].item() for t, c in enumerate(terms)) for d in range(7)])
    return out


def test_tokens_are_the_rounded_transform_lowest_frequency_of_all_dimensions_first():
    codec, chunk = FASTActionTokenizer(4), smooth(1, 4)[0]
    tokens = codec.encode(chunk)
    numbers = [round(10 * each) for row in cosine(chunk.double()) for each in row]
    assert tokens.tolist() == [n - codec.min_token for n in numbers] + [codec.end]  # before it is fitted: one by one


def test_what_is_encoded_comes_back_within_half_a_step_of_each_coefficient():
    codec, chunks = FASTActionTokenizer(8), smooth()
    codec.set_normalization(torch.linspace(-0.3, 0.3, 7), torch.linspace(0.2, 2, 7))
    codec.fit(chunks, scale=7.0)
    back = codec.decode(codec.encode(chunks))
    assert back.dtype == torch.float32 and back.shape == chunks.shape
    error = (back - chunks).double() / codec.gain
    worst = max(abs(each) for chunk in error[:20] for row in cosine(chunk) for each in row)
    assert 0.4 / 7 < worst <= 0.5 / 7 + 1e-6
    assert torch.equal(codec.encode(back), codec.encode(chunks))


def test_a_fitted_vocabulary_needs_fewer_tokens_and_is_the_same_each_time():
    chunks = smooth()
    plain, fitted, again = (FASTActionTokenizer(8, size=400) for _ in range(3))
    fitted.fit(chunks)
    again.fit(chunks.clone())
    assert again.bpe.to_str() == fitted.bpe.to_str() and fitted.known <= 400

    def lengths(codec: FASTActionTokenizer) -> Tensor:
        return (~codec.is_pad(codec.encode(chunks))).sum(-1)

    assert (lengths(plain) == 57).all()
    assert lengths(fitted).float().mean() < 0.75 * 57


def test_padding_is_what_stands_behind_the_first_end():
    codec = FASTActionTokenizer(1, size=10)
    tokens = torch.tensor([[3, 10, 10, 4], [1, 2, 3, 4], [10, 0, 10, 10]])
    assert codec.is_pad(tokens).int().tolist() == [[0, 0, 1, 1], [0, 0, 0, 0], [0, 1, 1, 1]]


def test_sequences_that_stand_for_no_chunk_are_made_one():
    codec = FASTActionTokenizer(2, size=40)
    codec.set_normalization(torch.arange(7) / 10, torch.full((7,), 0.5))
    nothing = torch.full((1, 15), codec.end)
    assert torch.equal(codec.decode(nothing)[0], (torch.arange(7) / 10).expand(2, 7))
    whole = codec.encode(smooth(1, 2))
    short = whole.clone()
    short[:, 9:] = codec.end
    zeroed = whole.clone()
    zeroed[:, 9:14] = -codec.min_token  # coefficients of nought
    assert torch.equal(codec.decode(short), codec.decode(zeroed))
    long = torch.cat([whole[:, :14], whole[:, :5]], 1)
    assert torch.equal(codec.decode(long), codec.decode(whole))


def test_coefficients_without_a_character_become_the_nearest_with_one():
    codec = FASTActionTokenizer(1, size=50)
    codec.fit(torch.tensor([-0.4, -0.2, 0.0, 0.1, 0.2, 0.3, 0.5]).reshape(1, 1, 7))
    far = torch.tensor([-9.0, 9.0, 0.0, 0.3, 9.0, -9.0, 0.1]).reshape(1, 7)
    expected = torch.tensor([-0.4, 0.5, 0.0, 0.3, 0.5, -0.4, 0.1])
    torch.testing.assert_close(codec.decode(codec.encode(far))[0], expected)


def byte_level(chunks: Tensor, scale: float, low: int, high: int) -> Tokenizer:
    """As the released one was trained: characters as bytes, which a coefficient above 127 has two of."""
    texts = []
    for chunk in chunks:
        texts.append("".join(chr(round(scale * each) - low) for row in cosine(chunk.double()) for each in row))
    bpe = Tokenizer(models.BPE())
    bpe.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    bpe.decoder = decoders.ByteLevel()
    alphabet = [*pre_tokenizers.ByteLevel.alphabet(), *(chr(n) for n in range(high - low + 1))]
    trainer = trainers.BpeTrainer(vocab_size=500, initial_alphabet=alphabet, show_progress=False)
    bpe.train_from_iterator(texts, trainer)
    return bpe


def test_a_released_folder_is_read_and_its_code_is_not(tmp_path):
    chunks = smooth(60, 4)
    bpe = byte_level(chunks, 10.0, -150, 150)
    bpe.save(str(tmp_path / "tokenizer.json"))
    described = {"processor_class": "UniversalActionProcessor", "scale": 10, "vocab_size": 600, "min_token": -150}
    described |= {"auto_map": {"AutoProcessor": "processing.UniversalActionProcessor"}, "time_horizon": None}
    (tmp_path / "processor_config.json").write_text(json.dumps(described))
    (tmp_path / "processing.py").write_text("raise SystemExit('run')")
    codec = FASTActionTokenizer.from_pretrained(tmp_path, 4)
    assert (codec.size, codec.end, codec.scale, codec.min_token) == (600, 600, 10.0, -150)
    tokens = codec.encode(chunks)
    first = "".join(chr(round(10 * each) + 150) for row in cosine(chunks[0].double()) for each in row)
    assert tokens[0][tokens[0] != codec.end].tolist() == bpe.encode(first).ids
    error = codec.decode(tokens) - chunks
    assert error.square().mean(1).sqrt().max() <= 0.05 + 1e-6
    # The first byte of a character alone is no coefficient.
    ids = bpe.encode(chr(290)).ids
    assert len(ids) == 2
    assert torch.equal(codec.decode(torch.tensor([[ids[0], codec.end]])), torch.zeros(1, 4, 7))


def test_it_is_saved_in_the_released_layout_and_copied(tmp_path):
    codec, chunks = FASTActionTokenizer(8, size=300), smooth()
    codec.fit(chunks, scale=8.0)
    codec.save_pretrained(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["processor_config.json", "tokenizer.json"]
    for other in (FASTActionTokenizer.from_pretrained(tmp_path, 8), copy.deepcopy(codec)):
        assert torch.equal(other.encode(chunks), codec.encode(chunks))
        assert torch.equal(other.decode(codec.encode(chunks)), codec.decode(codec.encode(chunks)))
    described = json.loads((tmp_path / "processor_config.json").read_text())
    assert {name: described[name] for name in ("scale", "time_horizon", "action_dim", "vocab_size")} == {
        "scale": 8.0,
        "time_horizon": 8,
        "action_dim": 7,
        "vocab_size": 300,
    }


def saved(tmp_path, **changed) -> None:
    FASTActionTokenizer(8, size=300).save_pretrained(tmp_path)
    path = tmp_path / "processor_config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changed))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"time_horizon": 50}, "time_horizon is 50, the policy's chunks have 8: take a tokenizer for these"),
        ({"action_dim": 14}, "action_dim is 14, the policy's chunks have 7"),
        ({"scale": None}, "processor_config.json has no number scale: this is no tokenizer of FAST"),
        ({"scale": -1.0}, "scale must be positive, got -1.0"),
    ],
)
def test_a_processor_config_that_does_not_fit_is_named(tmp_path, changed, message):
    saved(tmp_path, **changed)
    with pytest.raises(ValueError, match=message):
        FASTActionTokenizer.from_pretrained(tmp_path, 8)


@pytest.mark.parametrize("name", ["processor_config.json", "tokenizer.json"])
def test_a_missing_file_is_named(tmp_path, name):
    saved(tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises(FileNotFoundError, match=f"{name} is missing"):
        FASTActionTokenizer.from_pretrained(tmp_path, 8)


@pytest.mark.parametrize("content", ["", "{}", "null"])
def test_a_damaged_tokenizer_is_named(tmp_path, content):
    FASTActionTokenizer(4, size=60).save_pretrained(tmp_path)
    (tmp_path / "tokenizer.json").write_text(content)
    with pytest.raises(ValueError, match=r"tokenizer\.json is not a tokenizer of the library"):
        FASTActionTokenizer.from_pretrained(tmp_path, 4)


def test_no_token_is_the_middle_and_other_things_are_no_tokens():
    codec = FASTActionTokenizer(4, size=60)
    assert torch.equal(codec.decode(torch.zeros(2, 0, dtype=torch.int64)), torch.zeros(2, 4, 7))
    for tokens in (torch.zeros(2, 3), torch.tensor(1)):
        with pytest.raises(ValueError, match="tokens must be whole numbers"):
            codec.decode(tokens)


def test_another_kind_of_tokenizer_is_refused(tmp_path):
    saved(tmp_path)
    Tokenizer(models.WordLevel({"<unk>": 0}, unk_token="<unk>")).save(str(tmp_path / "tokenizer.json"))
    with pytest.raises(ValueError, match="no token of any coefficient: this is no tokenizer of FAST"):
        FASTActionTokenizer.from_pretrained(tmp_path, 8)


def test_bad_chunks_and_tokens_are_named():
    codec = FASTActionTokenizer(8, size=300, max_tokens=20)
    with pytest.raises(ValueError, match=r"for chunks \[..., 8, 7\], got \[5, 6, 7\]: chunk_length=8"):
        codec.encode(torch.zeros(5, 6, 7))
    with pytest.raises(ValueError, match="only finite numbers"):
        codec.fit(torch.full((5, 8, 7), torch.nan))
    with pytest.raises(ValueError, match="takes 57 tokens with the end, at most 20 are allowed: raise max_tokens"):
        codec.encode(smooth(1))
    with pytest.raises(ValueError, match="tokens must lie between 0 and 300, the end, got 301"):
        codec.decode(torch.tensor([[3, 301]]))
    with pytest.raises(
        ValueError, match=r"coefficients from -\d+ to \d+, a token each, and the vocabulary may have 30"
    ):
        FASTActionTokenizer(8, size=30).fit(smooth())
    with pytest.raises(ValueError, match="horizon must be at least 1, size at least 2"):
        FASTActionTokenizer(0)
