"""The report: one self-contained page, and its pictures as files beside it."""

from __future__ import annotations

import base64
import html
import json
import math
import shutil
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from connrsfm_graph.dense.layout import DENSE_FOLDER
from connrsfm_graph.files import folder_written_beside
from connrsfm_graph.metrics import Evaluation
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.report.charts import bar_chart, duration_chart, graph_chart, line_chart, range_chart
from connrsfm_graph.report.photos import photos_of
from connrsfm_graph.report.pictures import Painter
from connrsfm_graph.report.shown import DenseSurfaces, paints
from connrsfm_graph.report.surfaces import Surfaces
from connrsfm_graph.report.viewer import viewer
from connrsfm_graph.run_record import RunRecord

REPORT_FILE = "report.html"
PICTURES_FOLDER = "pictures"
MAX_FRAMES = 12
"""Images shown as pictures, spread evenly over the sequence; the turning view holds all."""


def remove_report(out: Path) -> None:
    """Remove page and dense surfaces of an earlier result from a folder, so that none stand beside another's."""
    (out / REPORT_FILE).unlink(missing_ok=True)
    for folder in (PICTURES_FOLDER, DENSE_FOLDER):
        shutil.rmtree(out / folder, ignore_errors=True)


def write_report(
    out: str | Path,
    reconstruction: Reconstruction,
    record: RunRecord,
    truth: np.ndarray | None = None,
    evaluation: Evaluation | None = None,
    images: Iterable[np.ndarray] | None = None,
) -> Path:
    """Write `report.html` and the folder `pictures` into `out`; returns the page's path.

    Dense surfaces are shown where `connrsfm densify` has left some in `out`.

    Args:
        out: folder, made where it does not exist.
        reconstruction, record: what is reported.
        truth: (F, P, 3) true points in camera frames, NaN where unknown.
        evaluation: figures against the same truth.
        images: F images (height, width[, 3]) uint8 RGB, texture of the surfaces and ground of the tracks; each is read
            once. Those of the dense surfaces where None.

    Raises:
        InputError: `out` is a file, or the truth does not fit the reconstruction.
    """
    surfaces = Surfaces.of(reconstruction, truth)
    dense = DenseSurfaces.beside(Path(out))
    if images is None and dense is not None:
        images = dense.images(reconstruction.n_frames)
    photos = None if images is None else photos_of(images, reconstruction.pixels)
    with folder_written_beside(out) as part:
        (part / PICTURES_FOLDER).mkdir()
        frames = _frames(
            reconstruction, surfaces, evaluation, Painter(reconstruction, surfaces, photos), part / PICTURES_FOLDER
        )
        sections = [
            _header(reconstruction, record, evaluation),
            _warnings(record.warnings),
            viewer(reconstruction, surfaces, photos, dense),
            frames,
            _charts(reconstruction, record, evaluation),
            _decisions(record.decisions),
            _settings(record),
        ]
        (part / REPORT_FILE).write_text(_document(record.source, sections), encoding="utf-8")
    return Path(out) / REPORT_FILE


def _document(title: str, sections: Sequence[str]) -> str:
    style = resources.files(__package__).joinpath("page.css").read_text(encoding="utf-8")
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)} – reconstruction</title>\n<style>\n{style}</style></head>\n"
        "<body><main>\n" + "\n".join(section for section in sections if section) + "\n</main></body></html>\n"
    )


def _header(reconstruction: Reconstruction, record: RunRecord, evaluation: Evaluation | None) -> str:
    seen = reconstruction.visible
    held = float((reconstruction.recovered & seen).sum() / max(seen.sum(), 1))
    figures = []
    if evaluation is not None:
        figures = [
            ("3D error", _number(evaluation.e3d_percent), "%"),
            ("shape error", _number(evaluation.shape_error_deg), "°"),
            ("3D RMSE", _number(evaluation.rmse_3d_percent), "%"),
        ]
    figures += [
        ("images", str(reconstruction.n_frames), ""),
        ("points", str(reconstruction.n_points), ""),
        ("recovered", f"{100 * held:.1f}", "%"),
        ("wrong tracks", str(int(reconstruction.outlier.sum())), ""),
        ("time", _number(sum(record.seconds.values())), "s"),
    ]
    shown = "".join(
        f"<div><dt>{name}</dt><dd>{value} <small>{unit}</small></dd></div>" for name, value, unit in figures
    )
    memory = f", peak memory {record.peak_memory_mib:.0f} MiB" if record.peak_memory_mib else ""
    return (
        f"<header><h1>{html.escape(Path(record.source).name)}</h1>"
        f"<p>Surface of every image from 2D tracks. Method <code>{html.escape(record.method)}</code>, "
        f"seed {record.seed}{memory}.</p></header>\n<dl class=figures>{shown}</dl>"
    )


def _warnings(warnings: Sequence[str]) -> str:
    items = "".join(f"<li>{html.escape(warning)}</li>" for warning in warnings)
    return f"<ul class=warnings>{items}</ul>" if items else ""


def _frames(
    reconstruction: Reconstruction, surfaces: Surfaces, evaluation: Evaluation | None, painter: Painter, folder: Path
) -> str:
    """Pictures of some images, also written into `folder`."""
    shown = surfaces.frames
    if len(shown) > MAX_FRAMES:
        shown = [shown[round(i)] for i in np.linspace(0, len(shown) - 1, MAX_FRAMES)]
    articles = []
    for f in shown:
        cells = []
        for picture in painter.pictures(f):
            (folder / f"{f:04d}_{picture.name}.png").write_bytes(picture.png())
            embedded = base64.b64encode(picture.webp()).decode()
            cells.append(
                f'<figure><img alt="{picture.caption}, {html.escape(reconstruction.frame_name(f))}" '
                f'src="data:image/webp;base64,{embedded}">'
                f"<figcaption>{picture.caption}</figcaption></figure>"
            )
        articles.append(
            f"<section class=frame><header><h3>{html.escape(reconstruction.frame_name(f))}</h3>"
            f"<p>{_frame_line(reconstruction, evaluation, f)}</p></header>"
            f"<div class=row>{''.join(cells)}</div></section>"
        )
    of = f"{len(shown)} of {reconstruction.n_frames} images" if len(shown) < reconstruction.n_frames else "Every image"
    return (
        f"<h2>Image by image</h2><p>{of}, all at one scale and with one set of colours. A point has the same colour in "
        f"the tracks of every image; a red cross is a track judged wrong.</p>{_scales(surfaces)}{''.join(articles)}"
    )


def _frame_line(reconstruction: Reconstruction, evaluation: Evaluation | None, f: int) -> str:
    parts = [f"{int(reconstruction.visible[f].sum())} points seen"]
    if missing := int((~reconstruction.recovered[f]).sum()):
        parts.append(f"{missing} not recovered")
    if filled := int(reconstruction.interpolated[f].sum()):
        parts.append(f"{filled} interpolated")
    if evaluation is not None and evaluation.per_frame[f]["e3d_percent"] is not None:
        figures = evaluation.per_frame[f]
        parts.append(f"3D error {_number(figures['e3d_percent'])} %")
        parts.append(f"shape error {_number(figures['shape_error_deg'])}°")
    return " · ".join(parts)


def _scales(surfaces: Surfaces) -> str:
    scales = "".join(
        f'<div><span>{way.ends[0]}</span><i style="background: linear-gradient(90deg, {", ".join(way.ramp)})"></i>'
        f"<span>{way.ends[1]}</span><span>{way.unit}</span></div>"
        for way in paints(surfaces)
        if way.name in ("depth", "error")
    )
    return f"<div class=scales>{scales}</div>"


def _charts(reconstruction: Reconstruction, record: RunRecord, evaluation: Evaluation | None) -> str:
    charts: list[tuple[str, str, str]] = []
    numbers = [str(f) for f in range(reconstruction.n_frames)]
    if evaluation is not None:
        e3d, shape = ([frame[key] for frame in evaluation.per_frame] for key in ("e3d_percent", "shape_error_deg"))
        charts.append(
            (
                "3D error",
                "Of every image after alignment by a similarity; dashed the mean.",
                bar_chart(e3d, numbers, "%"),
            )
        )
        charts.append(
            (
                "Shape error",
                "Angle between the normals of refitted surface and truth.",
                bar_chart(shape, numbers, "degrees"),
            )
        )
    charts.append(
        (
            "Conformal scale",
            "λ from image a to image b of every edge: median and middle 90 % of the points.",
            range_chart(*_scale_ranges(reconstruction), "λ"),
        )
    )
    charts.append(
        (
            "Image graph",
            "Pairs of images whose warps were used, heavier pairs stronger.",
            graph_chart(reconstruction.n_frames, reconstruction.edges, reconstruction.edge_weight),
        )
    )
    charts.append(("Cost", "After each iteration, on a logarithmic axis.", line_chart(record.cost_history, "cost")))
    charts.append(("Time", "Seconds of each stage.", duration_chart(record.seconds)))
    drawn = "".join(f"<div><h3>{name}</h3><p>{what}</p>{chart}</div>" for name, what, chart in charts if chart)
    return f"<h2>Figures</h2><div class=charts>{drawn}</div>"


def _scale_ranges(reconstruction: Reconstruction) -> tuple[list[tuple[float, float, float] | None], list[str]]:
    ranges: list[tuple[float, float, float] | None] = []
    for row in reconstruction.conformal_scale:
        known = row[np.isfinite(row) & (row > 0)]
        if len(known):
            low, middle, high = (float(value) for value in np.quantile(known, [0.05, 0.5, 0.95]))
            ranges.append((low, middle, high))
        else:
            ranges.append(None)
    return ranges, [f"{a}–{b}" for a, b in reconstruction.edges]


def _decisions(decisions: Mapping[str, Any]) -> str:
    rows = "".join(
        f"<tr><td>{html.escape(name.replace('_', ' '))}</td><td>{html.escape(_shown(value))}</td></tr>"
        for name, value in decisions.items()
    )
    return f"<h2>Chosen from the data</h2><table>{rows}</table>" if rows else ""


def _settings(record: RunRecord) -> str:
    settings = html.escape(json.dumps(record.configuration, indent=2, ensure_ascii=False))
    versions = html.escape(", ".join(f"{name} {version}" for name, version in record.versions.items()))
    return (
        "<h2>Settings</h2><details><summary>Resolved configuration</summary>"
        f"<pre><code>{settings}</code></pre></details>"
        f"<details><summary>Source</summary><pre><code>{html.escape(record.source)}</code></pre></details>"
        f"<footer>{versions}</footer>"
    )


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_shown(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_shown(item) for item in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _number(value: float | None) -> str:
    """Three significant digits, never in powers of ten for everyday sizes."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        digits = 2 if value == 0 else max(0, 2 - math.floor(math.log10(abs(value))))
        return f"{value:.{digits}f}"
    return f"{value:.2e}"
