"""Curves to draw, and what can be seen in figures and films."""

from itertools import pairwise

import numpy as np
from matplotlib.text import Text
from PIL import Image

EPISODES = np.arange(5000)
CORNERS = [0, 600, 1500, 2600, 4999]
COURSES = {  # values at the corners; straight lines between them
    "collective_return": [300, 560, 340, 470, 470],
    "equality": [0.90, 0.92, 0.83, 0.87, 0.87],
    "survival_steps": [1000, 1000, 620, 820, 820],
    "peacefulness": [830, 860, 560, 740, 740],
}


def society(replicas, noise, seed=0):
    """Curves with the study's phases and known corners, with independent noise for each replica."""
    rng = np.random.default_rng(seed)
    metrics = {}
    for name, course in COURSES.items():
        curve = np.interp(EPISODES, CORNERS, course)
        own = rng.normal(0, noise * np.ptp(curve), (replicas, len(EPISODES)))
        metrics[name] = curve + own
    return metrics


def see_that_it_can_be_read(figure, width_in=3.3):
    """No text is smaller than 6 pt or reaches over the edge, and no two names of ticks lie on each other."""
    figure.draw_without_rendering()
    assert figure.get_figwidth() == width_in
    for text in figure.findobj(Text):
        if text.get_visible() and text.get_text():
            assert text.get_fontsize() >= (6 if text.get_text() != figure.caption else 5)
    page = figure.bbox.padded(2)
    for axes in figure.axes:
        if not axes.get_visible():
            continue
        box = axes.get_tightbbox()
        assert page.x0 <= box.x0 <= box.x1 <= page.x1
        assert page.y0 <= box.y0 <= box.y1 <= page.y1
        for axis in (axes.xaxis, axes.yaxis):
            names = [name.get_window_extent() for name in axis.get_ticklabels() if name.get_text()]
            names = [name.padded(-1) for name in names if name.width and name.height]
            assert not any(one.overlaps(other) for one, other in pairwise(names))


def frames_of(path):
    """The pictures of a GIF, [frames, height, width, 3], and their durations in ms."""
    with Image.open(path) as film:
        pictures, durations = [], []
        for frame in range(film.n_frames):
            film.seek(frame)
            pictures.append(np.asarray(film.convert("RGB")))
            durations.append(film.info["duration"])
    return np.stack(pictures), durations
