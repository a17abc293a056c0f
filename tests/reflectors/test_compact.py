"""Prefix sampling, scores of growing videos, and goals as text."""

from __future__ import annotations

import pytest
import torch

from worldenv_trl.reflectors import CompactReflector, CompactReflectorConfig
from worldenv_trl.reflectors.prefixes import prefix_indices

TEXTS = ("open the drawer", "put the left bowl on the right bowl", "put the right bowl on the left bowl")


def make(**settings):
    torch.manual_seed(0)
    return CompactReflector(CompactReflectorConfig(TEXTS, image_size=16, num_frames=6, **settings)).eval()


@pytest.fixture
def reflector():
    return make()


def film(rows, frames, cameras=("agentview",), seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = (rows, frames, 3, 16, 16)
    return {camera: torch.randint(256, shape, generator=generator, dtype=torch.uint8) for camera in cameras}


def begun(reflector, video, texts):
    return reflector.begin({camera: frames[:, 0] for camera, frames in video.items()}, texts)


def piece(video, start, stop, rows=slice(None)):
    return {camera: frames[rows, start:stop] for camera, frames in video.items()}


@pytest.mark.parametrize("length", [1, 2, 5, 6, 7, 31])
def test_a_prefix_is_sampled_evenly_with_its_first_and_last_frame(length):
    index = prefix_indices(torch.tensor([length]), 6)[0]
    used = min(length, 6)
    assert index[0] == 0
    assert index[used - 1] == length - 1
    gaps = index[:used].diff()
    assert not used > 1 or int(gaps.max() - gaps.min()) <= 1


def test_short_prefixes_beside_long_ones_show_all_their_frames_once():
    index = prefix_indices(torch.tensor([3, 20]), 6)
    assert index[0].tolist() == [0, 1, 2, 2, 2, 2]


@pytest.mark.parametrize("cameras", [("agentview",), ("agentview", "wrist")])
def test_scores_are_those_of_each_prefix_alone_in_whatever_pieces_the_frames_come(cameras):
    reflector, video, texts = make(cameras=cameras), film(3, 14, cameras), list(TEXTS)
    state = begun(reflector, video, texts)
    streamed = [state["score"].unsqueeze(1)]
    for start, stop in ((1, 4), (4, 5), (5, 13), (13, 14)):
        state, scores = reflector.extend(state, piece(video, start, stop))
        streamed.append(scores)
        torch.testing.assert_close(state["score"], scores[:, -1])
    streamed = torch.cat(streamed, 1)
    for row in range(3):
        features = reflector.encode(piece(video, 0, 14, row))
        for last in range(14):
            index = prefix_indices(torch.tensor([last + 1]), 6)[0]
            query = reflector.query(reflector.vocabulary.ids([texts[row]]))
            alone = reflector.logits(features[index][None], torch.tensor([len(index)]), query).sigmoid()
            torch.testing.assert_close(streamed[row, last], alone[0])


def test_videos_of_different_lengths_are_extended_together_as_they_would_be_alone(reflector):
    video = film(3, 12)
    alone = begun(reflector, video, list(TEXTS))
    alone, expected = reflector.extend(alone, piece(video, 1, 12))
    state = begun(reflector, video, list(TEXTS))
    ahead, _ = reflector.extend(state[1:2], piece(video, 1, 6, slice(1, 2)))  # the second is five frames ahead
    features = torch.zeros(3, 6, 96)
    features[:, :1], features[1] = state["features"], ahead["features"][0]
    state["features"], state["seen"] = features, torch.tensor([1, 6, 1])
    kept = state.clone()
    new = {
        "agentview": torch.stack([video["agentview"][row, start : start + 4] for row, start in enumerate((1, 6, 1))])
    }
    grown, scores = reflector.extend(state, new)
    assert (state == kept).all()  # what was given is not changed
    assert grown["seen"].tolist() == [5, 10, 5]
    for row, start in enumerate((1, 6, 1)):
        torch.testing.assert_close(scores[row], expected[row, start - 1 : start + 3])


@pytest.mark.parametrize("length", [1, 3])
def test_padding_frames_do_not_reach_the_score(reflector, length):
    features, query = torch.randn(1, 6, 96), torch.randn(1, 96)
    spoilt = features.clone()
    spoilt[:, length:] = torch.randn(6 - length, 96)
    lengths = torch.tensor([length])
    torch.testing.assert_close(reflector.logits(features, lengths, query), reflector.logits(spoilt, lengths, query))


@pytest.mark.parametrize("cameras", [("agentview",), ("wrist", "agentview")])
def test_a_reloaded_reflector_gives_the_same_scores_and_knows_what_it_was_trained_for(tmp_path, cameras):
    reflector = make(cameras=cameras)
    reflector.save_pretrained(tmp_path)
    again = CompactReflector.from_pretrained(tmp_path).eval()
    assert (again.cameras, again.image_size, again.instructions) == (cameras, 16, TEXTS)
    video = film(3, 5, cameras)
    _, scores = again.extend(begun(again, video, list(TEXTS)), piece(video, 1, 5))
    assert torch.equal(scores, reflector.extend(begun(reflector, video, list(TEXTS)), piece(video, 1, 5))[1])


def test_every_camera_reaches_the_score():
    reflector, cameras = make(cameras=("agentview", "wrist")), ("agentview", "wrist")
    video = film(1, 1, cameras)
    score = begun(reflector, video, TEXTS[:1])["score"]
    for camera in cameras:
        changed = video | {camera: 255 - video[camera]}
        assert (begun(reflector, changed, TEXTS[:1])["score"] - score).abs() > 1e-5


def test_the_score_depends_on_the_instruction_and_not_on_the_rows_beside_it(reflector):
    video = {"agentview": film(1, 1)["agentview"].expand(3, 1, 3, 16, 16)}
    scores = begun(reflector, video, list(TEXTS))["score"]
    assert (scores[0] - scores[1]).abs() > 1e-5
    torch.testing.assert_close(begun(reflector, piece(video, 0, 1, slice(1)), TEXTS[:1])["score"], scores[:1])


def test_an_unseen_instruction_is_warned_of_and_goes_by_the_words_that_are_known(reflector):
    video = film(1, 1)
    with pytest.warns(UserWarning, match="never trained on the instruction 'open the vault'"):
        unseen = begun(reflector, video, ["open the vault"])["score"]
    with pytest.warns(UserWarning, match="'open the hatch'"):
        other = begun(reflector, video, ["open the hatch"])["score"]
    assert torch.equal(unseen, other)  # an unknown word is an unknown word


def test_frames_of_another_size_or_camera_and_settings_out_of_range_are_refused(reflector):
    with pytest.raises(ValueError, match=r"'agentview' must be \[n, 3, 16, 16\], got \[1, 3, 8, 8\]"):
        reflector.begin({"agentview": torch.zeros(1, 3, 8, 8, dtype=torch.uint8)}, TEXTS[:1])
    with pytest.raises(ValueError, match="looks at 'agentview', the frames are of wrist"):
        reflector.begin({"wrist": torch.zeros(1, 3, 16, 16, dtype=torch.uint8)}, TEXTS[:1])
    with pytest.raises(ValueError, match="at least one instruction"):
        CompactReflectorConfig(())
    with pytest.raises(ValueError, match="num_frames must be at least 2"):
        CompactReflectorConfig(TEXTS, num_frames=1)
    with pytest.raises(ValueError, match="multiple of 8 px and at least 16, got 20"):
        CompactReflectorConfig(TEXTS, image_size=20)
    with pytest.raises(ValueError, match="each once"):
        CompactReflector(CompactReflectorConfig(TEXTS, cameras=("wrist", "wrist")))
