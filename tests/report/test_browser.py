"""The report in a real browser."""

from __future__ import annotations

import io

import numpy as np
import pytest
from browser import CHROMIUM, Browser
from pages import STEPS, evidence, run_folder
from PIL import Image

from worldenv_trl.report import RunRecord, write_report

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium on the PATH: apt-get install chromium")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return write_report(RunRecord.read(run_folder(folder / "run")), folder / "report.html", evidence())


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


def brightness(picture: bytes) -> float:
    return float(np.asarray(Image.open(io.BytesIO(picture)).convert("L")).mean())


def test_it_renders_in_both_themes_and_on_a_phone_without_an_error_or_a_request(browser, page):
    browser.open(page)
    light = brightness(browser.picture())
    browser.open(page, scheme="dark")
    assert light > 200 and brightness(browser.picture()) < 60
    browser.open(page, width=390)
    assert browser.ask("document.documentElement.scrollWidth") == 390  # wide things scroll inside themselves
    assert browser.ask("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
    assert browser.ask("document.querySelectorAll('svg image').length") == 8
    assert set(browser.requests) == {page.resolve().as_uri()} and browser.errors == []


def test_every_video_plays(browser, page):
    browser.open(page)
    played = browser.ask(
        """Promise.all([...document.querySelectorAll('video')].map(async video => {
             await video.play();
             await new Promise(done => setTimeout(done, 400));
             video.pause();
             return [video.currentTime > 0, video.videoWidth, video.duration];
           }))"""
    )
    assert played == [[True, 2 * 32 * 3 + 6, pytest.approx((STEPS + 1) / 10, abs=0.05)]] * 4
    assert browser.errors == []


def test_the_strip_follows_the_video_step_by_step_from_the_keyboard(browser, page):
    browser.open(page)
    browser.ask("document.querySelector('#clip-1 [data-step=\"5\"]').focus()")
    seeked = (
        "new Promise(done => document.querySelector('#clip-1 video').addEventListener('seeked', done, {once: true}))"
    )
    browser.ask(f"void (window.seeked = {seeked})")
    browser.ask("document.activeElement.click()")  # the gripper closes at step 5
    browser.ask("window.seeked")
    assert "step 5 ·" in browser.ask("document.querySelector('#clip-1 .readout').textContent")
    browser.ask(f"void (window.seeked = {seeked})")
    browser.press("ArrowRight")
    browser.ask("window.seeked")
    assert "step 6 ·" in browser.ask("document.querySelector('#clip-1 .readout').textContent")
    x = browser.ask("[...['x0', 'x1'].map(k => +document.querySelector('#clip-1 .strip').dataset[k]),"
                    " +document.querySelector('#clip-1 .cursor').getAttribute('x1')]")  # fmt: skip
    assert x[2] == pytest.approx(x[0] + (x[1] - x[0]) * 6 / STEPS, abs=0.1)
    assert "step 0 ·" in browser.ask("document.querySelector('#clip-0 .readout').textContent")
