"""The VLM reflectors against the model's own forward, and what they refuse."""

from __future__ import annotations

import json

import pytest
import torch

pytest.importorskip("transformers")
from tiny_vlm import WORDS, save_tiny_vlm, tiny_model, tiny_tokenizer
from videos import patches

from worldenv_trl.data import score_episodes
from worldenv_trl.objectives import ReflectorLoss
from worldenv_trl.reflectors import PromptReflector, PromptReflectorConfig, VLMReflector, VLMReflectorConfig
from worldenv_trl.reflectors.video_language_model import VideoLanguageModel

TEXTS = ["push left before right", "open the top drawer"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return str(save_tiny_vlm(tmp_path_factory.mktemp("vlm")))


@pytest.fixture(scope="module")
def reflector(folder):
    torch.manual_seed(1)
    reflector = VLMReflector(VLMReflectorConfig(folder, num_frames=4, prompts_per_call=3))
    for parameter in reflector.head.parameters():  # scores that differ
        parameter.data += 0.3 * torch.randn_like(parameter)
    return reflector


@pytest.fixture
def video():
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (2, 11, 3, 20, 28), generator=generator, dtype=torch.uint8)


def streamed(reflector, video, pieces, texts=TEXTS):
    state = reflector.begin({"agentview": video[:, 0]}, texts)
    scores = [state["score"].unsqueeze(-1)]
    start = 1
    for count in pieces:
        state, new = reflector.extend(state, {"agentview": video[:, start : start + count]})
        scores.append(new)
        start += count
    return torch.cat(scores, 1)


def states_of_the_whole_model(reflector, frames, text):
    """The model's own forward, of prompt and frames [L, 3, H, W] in one: its last states [S, D] and logits [S, W]."""
    vlm = reflector.vlm
    before, after = vlm.prompt_ids(reflector.config.text(text))
    tokens = [vlm.video_token] * (len(frames) * vlm.tokens_per_frame + 1)
    with torch.no_grad():
        out = vlm.net(
            input_ids=torch.tensor([before + tokens + after]),
            pixel_values_videos=vlm.prepare(frames).unsqueeze(0),
            output_hidden_states=True,
        )
    return out.hidden_states[-1][0], out.logits[0]


def evenly(length, count):
    """Closed form: round(k (length - 1) / (count - 1)), half to even as torch rounds."""
    count = min(length, count)
    return [0] if count == 1 else [round(k * (length - 1) / (count - 1)) for k in range(count)]


@pytest.mark.parametrize("pooling", ["last", "mean"])
def test_a_prefix_of_cached_frames_is_judged_as_the_whole_model_judges_it(folder, video, pooling):
    torch.manual_seed(1)
    reflector = VLMReflector(VLMReflectorConfig(folder, num_frames=4, pooling=pooling))
    scores = streamed(reflector, video, (3, 7))
    for row, text in enumerate(TEXTS):
        for last in (0, 1, 4, 10):
            frames = video[row, evenly(last + 1, 4)]
            states, _ = states_of_the_whole_model(reflector, frames, text)
            pooled = states[-1] if pooling == "last" else states.mean(0)
            expected = reflector.head(pooled).sigmoid().item()
            assert scores[row, last].item() == pytest.approx(expected, abs=1e-5)


def test_the_prompt_reflector_is_the_softmax_of_two_logits(folder, video):
    reflector = PromptReflector(PromptReflectorConfig(folder, num_frames=5))
    scores = streamed(reflector, video, (10,))
    words = len(WORDS)
    yes, no = (5 + WORDS.index(word) for word in ("Yes", "No"))
    for row, text in enumerate(TEXTS):
        _, logits = states_of_the_whole_model(reflector, video[row, evenly(11, 5)], text)
        assert logits.shape[-1] == words + 5
        odds = (logits[-1, yes] - logits[-1, no]).item()
        assert scores[row, -1].item() == pytest.approx(1 / (1 + torch.tensor(-odds).exp().item()), abs=1e-5)


@pytest.mark.parametrize("pieces", [(10,), (1,) * 10, (3, 4, 3)])
def test_scores_do_not_depend_on_the_pieces_frames_come_in(reflector, video, pieces):
    torch.testing.assert_close(
        streamed(reflector, video, pieces), streamed(reflector, video, (5, 5)), atol=1e-5, rtol=0
    )


def test_a_row_does_not_depend_on_the_rows_beside_it(reflector, video):
    both = streamed(reflector, video, (10,))
    for row in range(2):
        alone = streamed(reflector, video[row : row + 1], (10,), TEXTS[row : row + 1])
        torch.testing.assert_close(both[row : row + 1], alone, atol=1e-5, rtol=0)


def test_the_goal_and_the_video_count(reflector, video):
    scores, other = streamed(reflector, video, (10,)), streamed(reflector, video, (10,), TEXTS[::-1])
    assert (scores - other).abs().max() > 1e-3 and (scores[:, 1:] - scores[:, :-1]).abs().max() > 1e-3


@pytest.mark.parametrize("pieces", [(10,), (2, 5, 3)])
def test_between_two_judged_frames_the_score_is_held(folder, reflector, video, pieces):
    seldom = VLMReflector(VLMReflectorConfig(folder, num_frames=4, score_every=4), vlm=reflector.vlm)
    seldom.load_state_dict(reflector.state_dict())
    every = streamed(reflector, video, (10,))
    expected = every[:, [0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8]]
    torch.testing.assert_close(streamed(seldom, video, pieces), expected, atol=1e-5, rtol=0)


def test_a_new_prefix_costs_one_language_pass_and_no_old_frame(reflector, video, monkeypatch):
    seen, passes = [], []
    prepare, hidden = VideoLanguageModel.prepare, VideoLanguageModel.hidden
    monkeypatch.setattr(VideoLanguageModel, "prepare", lambda self, f: (seen.append(len(f)), prepare(self, f))[1])
    monkeypatch.setattr(VideoLanguageModel, "hidden", lambda self, v, p: (passes.append(len(v)), hidden(self, v, p))[1])
    streamed(reflector, video[:1], (1,) * 10, TEXTS[:1])
    assert sum(seen) == 11 and passes == [1] * 11


def test_frames_are_resized_by_the_shorter_side_and_cropped_at_the_centre(folder):
    vlm = VideoLanguageModel.load(folder)
    frames = torch.zeros(1, 3, 12, 36, dtype=torch.uint8)
    frames[..., 12:24] = 255  # the middle third: all that a square crop shows
    torch.testing.assert_close(vlm.prepare(frames)[..., 4:-4], torch.ones(1, 3, 24, 16), atol=0.05, rtol=0)
    grey = vlm.prepare(torch.full((1, 3, 30, 20), 51, dtype=torch.uint8))  # 51 / 255 = 0.2
    torch.testing.assert_close(grey, torch.full((1, 3, 24, 24), -0.6))


def test_the_checkpoints_own_colours_are_used(tmp_path):
    save_tiny_vlm(tmp_path)
    (tmp_path / "preprocessor_config.json").write_text(
        json.dumps({"image_mean": [0, 0.5, 1], "image_std": [1, 0.5, 2]})
    )
    shown = VideoLanguageModel.load(str(tmp_path)).prepare(torch.full((1, 3, 24, 24), 255, dtype=torch.uint8))
    assert shown[0, :, 0, 0].tolist() == [1.0, 1.0, 0.0]


def test_only_the_head_is_saved_and_scores_come_back(folder, reflector, video, tmp_path):
    reflector.log_scale.data.fill_(0.3)
    saved = reflector.save_pretrained(tmp_path / "reflector")
    assert (saved / "model.safetensors").stat().st_size < 4 * sum(
        p.numel() for n, p in reflector.named_parameters() if not n.startswith("vlm.")
    ) + 4096
    again = VLMReflector.from_pretrained(saved)
    assert again.config == reflector.config
    torch.testing.assert_close(streamed(again, video, (10,)), streamed(reflector, video, (10,)), atol=1e-6, rtol=0)
    reflector.log_scale.data.zero_()


def test_the_prompt_reflector_is_saved_by_its_question(folder, video, tmp_path):
    reflector = PromptReflector(PromptReflectorConfig(folder, num_frames=3, prompt="Yes or No : {instruction}?"))
    again = PromptReflector.from_pretrained(reflector.save_pretrained(tmp_path))
    torch.testing.assert_close(streamed(again, video, (10,)), streamed(reflector, video, (10,)))


def test_whole_episodes_are_scored(reflector):
    episodes = patches(3, ["push left before right"], frames=6)
    assert score_episodes(reflector, episodes).shape == (3, 6)


def test_the_frozen_model_stays_frozen_and_in_evaluation_mode(reflector):
    reflector.train()
    assert not reflector.vlm.net.training and reflector.head.training
    assert not any(parameter.requires_grad for parameter in reflector.vlm.parameters())
    reflector.eval()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_frames": 1}, "num_frames must be at least 2"),
        ({"score_every": 0}, "score_every and prompts_per_call must be at least 1, got 0"),
        ({"prompt": "Is it done?"}, "prompt must hold {instruction}"),
        ({"template": "<video>"}, "template must hold {prompt}"),
        ({"pooling": "max"}, "pooling must be last or mean, got 'max'"),
        ({"dtype": "int8"}, "dtype must be auto, float32, bfloat16 or float16, got 'int8'"),
        ({"hidden_dim": 0}, "hidden_dim must be at least 1, got 0"),
    ],
)
def test_settings_out_of_range_are_refused(folder, settings, message):
    with pytest.raises(ValueError, match=message):
        VLMReflectorConfig(folder, **settings)


def test_what_is_no_checkpoint_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no video language model at .*nowhere: .*nowhere is missing"):
        VLMReflector(VLMReflectorConfig(str(tmp_path / "nowhere")))
    save_tiny_vlm(tmp_path)
    (tmp_path / "model.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=r"no \*\.safetensors in"):
        VideoLanguageModel.load(str(tmp_path))
    (tmp_path / "pytorch_model.bin").touch()
    with pytest.raises(ValueError, match=r"a pickle, pytorch_model\.bin, which may run code .* convert it"):
        VideoLanguageModel.load(str(tmp_path))
    (tmp_path / "model.safetensors").touch()
    (tmp_path / "config.json").write_text('{"model_type": "llama"}')
    with pytest.raises(ValueError, match="holds a llama, a VLM reflector reads llava_onevision"):
        VideoLanguageModel.load(str(tmp_path))


def test_a_tokenizer_without_the_video_is_refused(folder):
    with pytest.raises(ValueError, match=r"must hold the video token \(id 2\) once, the tokenizer finds it 0 times"):
        VLMReflector(VLMReflectorConfig(folder, template="{prompt}"))


@pytest.mark.parametrize("word", ["Perhaps", "Yes or", "No"])
def test_words_of_several_tokens_or_twice_the_same_are_refused(folder, word):
    with pytest.raises(ValueError, match=r"one token|different tokens"):
        PromptReflector(PromptReflectorConfig(folder, yes=word))


def test_another_camera_is_refused(reflector, video):
    with pytest.raises(ValueError, match="looks at 'agentview', the frames are of wrist"):
        reflector.begin({"wrist": video[:, 0]}, TEXTS)


def test_a_model_of_another_class_is_refused():
    model = tiny_model()
    model.config.model_type = "qwen2"
    with pytest.raises(ValueError, match="got a qwen2: name a LLaVA-OneVision"):
        VideoLanguageModel(model, tiny_tokenizer())


def test_what_a_training_continues_from_is_the_head_alone(folder, reflector):
    state = ReflectorLoss(reflector).state_dict()
    assert {name.split(".")[1] for name in state} == {"head", "log_scale", "shift"}
    torch.manual_seed(9)
    fresh = VLMReflector(reflector.config, vlm=reflector.vlm)
    loss = ReflectorLoss(fresh)
    loss.load_state_dict(state)
    assert all(torch.equal(a, b) for a, b in zip(fresh.head.parameters(), reflector.head.parameters(), strict=True))
    with pytest.raises(RuntimeError, match=r"Missing key\(s\) in state_dict: .*head\.3\.bias"):
        fresh.load_state_dict({name: value for name, value in fresh.state_dict().items() if name != "head.3.bias"})
