"""The page in a browser without network: no errors, and slider, rotation and colours change the picture."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph.dense.densify import densify
from connrsfm_graph.report.page import write_report

from .test_page import RECORD, bowls

BROWSERS = ("chromium", "chromium-browser", "google-chrome")

WATCH = """<script>
window.problems = [];
addEventListener("error", event => problems.push(event.message));
addEventListener("unhandledrejection", event => problems.push(String(event.reason)));
console.error = console.warn = (...parts) => problems.push(parts.join(" "));
</script>"""
"""Put before everything else of the page."""

DRIVE = """<pre id=found></pre><script>
(async () => {
  const view = document.getElementById("view"), found = {};
  const wait = () => new Promise(done => setTimeout(done, 400));
  const look = async name => {
    await wait();
    const { width, height } = view, data = view.getContext("2d").getImageData(0, 0, width, height).data;
    let drawn = 0, hash = 0, grey = 0;
    for (let i = 0; i < data.length; i += 4) {
      if (!data[i + 3]) continue;
      drawn++; grey += data[i] === data[i + 1] && data[i] === data[i + 2];
      hash = (hash * 31 + data[i] + 7 * data[i + 1] + 13 * data[i + 2] + i) % 1000000007;
    }
    const share = drawn / (width * height), shown = document.getElementById("name").value;
    found[name] = { share, hash, grey: grey / drawn, name: shown };
  };
  const set = (id, value) => {
    const control = document.getElementById(id);
    if (control.type === "checkbox") control.checked = value; else control.value = value;
    control.dispatchEvent(new Event("input"));
  };
  const mouse = (kind, x, y) => view.dispatchEvent(new PointerEvent(kind, { bubbles: true, clientX: x, clientY: y }));
  await look("first");
  mouse("pointerdown", 100, 100); mouse("pointermove", 220, 140); mouse("pointerup", 220, 140);
  await look("turned");
  view.dispatchEvent(new MouseEvent("dblclick"));
  await look("back");
  set("frame", 2);
  await look("third");
  for (const option of document.getElementById("paint").options) {
    set("paint", option.value);
    await look(option.text);
  }
  if (document.getElementById("truth")) { set("truth", true); await look("lines"); }
  document.getElementById("play").click(); await wait(); document.getElementById("play").click();
  await look("played");
  found.problems = problems;
  found.loaded = performance.getEntriesByType("resource").map(entry => entry.name);
  found.loaded = found.loaded.filter(name => !name.startsWith("data:"));
  document.getElementById("found").textContent = JSON.stringify(found);
})();
</script>"""
"""Put after everything else; leaves what it saw in the page."""


def driven(page: Path, folder: Path) -> dict:
    """What the script above found in a page."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip(f"no browser to try the page in (looked for {', '.join(BROWSERS)})")
    text = page.read_text(encoding="utf-8")
    copy = folder / "driven.html"
    copy.write_text(
        text.replace("<head>", f"<head>{WATCH}", 1).replace("</body>", f"{DRIVE}</body>", 1), encoding="utf-8"
    )
    options = ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--window-size=1000,900")
    closed = ("--disable-background-networking", "--host-resolver-rules=MAP * ~NOTFOUND")
    profile = f"--user-data-dir={folder / 'profile'}"
    command = [browser, *options, *closed, profile, "--virtual-time-budget=30000", "--dump-dom", copy.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=100)
    told = re.search(r"<pre id=\"found\">(.+?)</pre>", done.stdout)
    assert told, done.stderr[-2000:]
    return json.loads(told[1].replace("&amp;", "&"))


@pytest.mark.parametrize("with_images", [True, False])
def test_view_turns_slides_and_changes_colour(tmp_path: Path, with_images: bool) -> None:
    made = bowls(F=4)
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 255, (480, 640, 3), dtype=np.uint8) for _ in range(4)] if with_images else None
    truth = made.points * [1.0, 1.0, 1.1]
    seen = driven(write_report(tmp_path / "out", made, RECORD, truth, images=images), tmp_path)
    assert seen.pop("problems") == []
    assert seen.pop("loaded") == []
    assert all(0.05 < look["share"] < 0.9 for look in seen.values())
    assert seen["turned"]["hash"] != seen["first"]["hash"] == seen["back"]["hash"]
    assert [seen[name]["name"] for name in ("first", "third")] == ["image 0", "image 2"]
    assert seen["played"]["name"] != "image 2"
    colours = ["depth", "error", "conformal scale", "lines", *(["image"] if with_images else [])]
    assert len({seen[name]["hash"] for name in ("first", *colours)}) == len(colours) + 1
    assert max(seen[name]["grey"] for name in colours) < 0.2


def test_dense_surface_with_its_texture(tmp_path: Path) -> None:
    import cv2

    made = bowls(F=3, P=120)
    (tmp_path / "images").mkdir()
    for f in range(3):
        red = np.zeros((480, 640, 3), np.uint8)
        red[..., 2] = 200  # blue, green, red
        cv2.imwrite(str(tmp_path / "images" / f"{f}.png"), red)
    densify(made, tmp_path / "images", tmp_path / "out")
    page = write_report(tmp_path / "out", made, RECORD)
    assert "Dense surfaces" in page.read_text()
    seen = driven(page, tmp_path)
    assert seen["problems"] == []
    assert 0.05 < seen["image"]["share"] < 0.9
    assert seen["image"]["grey"] < 0.01
    assert seen["turned"]["hash"] != seen["first"]["hash"]
