"""Window: shows images on screen, with Matplotlib."""

import os
from typing import Any

from cprl.commons.world import Bytes


class Window:
    """A window that shows one image at a time; the first image opens it.

    Args:
        title: The title of the window.

    Raises:
        RuntimeError: If Matplotlib cannot open a window and MPLBACKEND is not set.
    """

    def __init__(self, title: str) -> None:
        import matplotlib
        from matplotlib.backends.registry import BackendFilter, BackendRegistry

        registry: Any = BackendRegistry()  # type: ignore[no-untyped-call]
        backend = matplotlib.get_backend()
        self._opens = backend.lower() in registry.list_builtin(BackendFilter.INTERACTIVE)
        if not self._opens and "MPLBACKEND" not in os.environ:
            raise RuntimeError(
                f'render_mode is "human", but Matplotlib\'s backend "{backend}" cannot open a window; '
                'use render_mode="rgb_array", or choose a backend with MPLBACKEND'
            )
        self._title = title
        self._figure: Any = None
        self._image: Any = None

    def show(self, picture: Bytes) -> None:
        """Shows an image, uint8 [rows, columns, 3], RGB."""
        from matplotlib import pyplot

        if self._figure is None:
            self._figure = pyplot.figure(num=f"{self._title} {id(self):x}", layout="constrained")
            axes = self._figure.add_subplot()
            axes.set_axis_off()
            self._image = axes.imshow(picture)
            if self._opens:
                self._figure.canvas.manager.set_window_title(self._title)
                self._figure.show()
        self._image.set_data(picture)
        self._figure.canvas.draw_idle()
        self._figure.canvas.flush_events()

    def close(self) -> None:
        """Closes the window; the next image opens a new one."""
        if self._figure is not None:
            from matplotlib import pyplot

            pyplot.close(self._figure)
            self._figure = None
