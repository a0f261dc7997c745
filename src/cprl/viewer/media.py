"""What users log, as Rerun takes it: numbers, histograms and videos."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def numbers_in(data: Any) -> NDArray[Any]:
    """The numbers of a tensor, an array or a list, [n]."""
    return np.asarray(data.detach().cpu() if isinstance(data, Tensor) else data).reshape(-1)


def histogram_of(numbers: NDArray[Any], *, bins: int) -> Any:
    """A `rerun.BarChart` of numbers, [n], in equal bins."""
    import rerun as rr

    counts, edges = np.histogram(numbers, bins=bins)
    return rr.BarChart(counts, abscissa=(edges[:-1] + edges[1:]) / 2)


def images_of(video: Tensor) -> NDArray[np.uint8]:
    """The images of a video, uint8 [T, H, W, C].

    Raises:
        ValueError: for a video that is not [T, C, H, W] or [1, T, C, H, W].
    """
    clip = torch.as_tensor(video).cpu()
    clip = clip[0] if clip.ndim == 5 else clip
    if clip.ndim != 4:
        raise ValueError(f"the video is {list(video.shape)}; allowed: [T, C, H, W] or [1, T, C, H, W]")
    images: NDArray[np.uint8] = clip.permute(0, 2, 3, 1).to(torch.uint8).numpy()
    return images


def format_of(images: NDArray[np.uint8]) -> Any:
    """The `rerun.components.ImageFormat` of images, [T, H, W, C]."""
    import rerun as rr

    return rr.components.ImageFormat(
        width=images.shape[2],
        height=images.shape[1],
        color_model="L" if images.shape[3] == 1 else "RGB",
        channel_datatype=rr.ChannelDatatype.U8,
    )
