"""A study in the Rerun viewer while it runs: the table of its trials, and the returns of finished ones."""

import time
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from cprl.arguments import refusal
from cprl.output import console
from cprl.runs.curves import curves_of, running_mean
from cprl.studies.overview import Row, Snapshot, markdown
from cprl.viewer.streams import check_watch, open_live

STUDY: Final = "cprl study"
"""The application id, for which a viewer keeps a layout of its own."""
TABLE, RETURNS = "table", "collective_return"
"""Entities of the recording."""
_PERIOD_S: Final = 4.0


def check_live(watch: object) -> None:
    """Checks the `watch` of a study: "off", or live; raises a ValueError for anything else."""
    if not isinstance(watch, str) or watch == "file":
        raise refusal("watch", watch, '"off", "serve", "spawn" or "connect rerun+http://HOST:PORT/proxy"')
    check_watch(watch)


class LiveStudy:
    """Sends a study to viewers; a context manager.

    A viewer that goes away or stands still never delays a trial, see `cprl.viewer.sending`.

    Args:
        watch: "serve", "spawn" or "connect ADDRESS", see `cprl.viewer.streams.open_live`.
        runs: the directory of the study's runs.
        title: what the study is called.
    """

    def __init__(self, watch: str, *, runs: Path, title: str) -> None:
        self._runs, self._title = runs, title
        self._text, self._drawn = "", set[str]()
        self._live = open_live(
            watch, f"{title}-{time.time_ns()}", _layout(), period_s=_PERIOD_S, application=STUDY
        )
        for where, address in self._live.addresses.items():
            console().print(f"Watch live ({where}): {address}", soft_wrap=True, highlight=False)
        self._do(lambda recording: recording.send_recording_name(title))

    def show(self, snapshot: Snapshot) -> None:
        """Shows the table as it is now, and the curves of trials that have finished since."""
        import rerun as rr

        text = markdown(snapshot, title=self._title)
        if text != self._text:
            self._text = text
            document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
            self._do(lambda recording: recording.log(TABLE, document, static=True))
        for row in snapshot.rows:
            if row.state == "finished" and row.trial.name not in self._drawn:
                self._drawn.add(row.trial.name)
                self._draw(row)

    def _draw(self, row: Row) -> None:
        """Sends the curve of a finished trial."""
        import rerun as rr

        try:
            episodes, values = returns_of(self._runs / row.trial.name)
        except (OSError, ValueError):  # its directory was just deleted or damaged: the table says it
            return
        entity = [RETURNS, row.label]

        def send(recording: Any) -> None:
            recording.log(entity, rr.SeriesLines(names=row.label), static=True)
            recording.send_columns(
                rr.new_entity_path(entity),
                [rr.TimeColumn("episode", sequence=episodes)],
                rr.Scalars.columns(scalars=values),
            )

        self._do(send)

    def _do(self, what: Any) -> None:
        if self._live.stream is not None:
            self._live.stream.do(what)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._live.stream is not None:
            self._live.stream.close()
        self._live.close()


def returns_of(run: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The collective return of a run, mean of its replicas, as running means over a tenth of its episodes.

    Args:
        run: the directory of a finished run.

    Returns:
        The first episode of each mean, int64 [E], and the means, float64 [E].
    """
    curves = curves_of(run)
    if "collective_return" in curves:
        whole = curves["collective_return"]
    else:  # a game without harvests
        whole = sum((own for name, own in curves.items() if name.startswith("return_")), np.zeros(1))
    values = running_mean(whole, max(1, whole.shape[-1] // 10)).mean(0)
    return np.arange(len(values), dtype=np.int64), values


def _layout() -> Any:
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.TextDocumentView(name="Trials", origin=f"/{TABLE}"),
            rrb.TimeSeriesView(name="Collective return of finished trials", origin=f"/{RETURNS}"),
            column_shares=[2, 3],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="episode"),
    )
