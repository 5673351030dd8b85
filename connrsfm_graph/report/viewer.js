// Turns the surfaces with the mouse or a finger: painter's algorithm on a 2D canvas, no library.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("surfaces").textContent);
  const canvas = document.getElementById("view"), pen = canvas.getContext("2d");
  const frame = document.getElementById("frame"), name = document.getElementById("name");
  const paint = document.getElementById("paint"), truth = document.getElementById("truth");
  const start = { right: 40, up: 22, zoom: 1 };
  let eye = { ...start }, grip = null;

  const ramps = data.ramps.map(stops => stops.map(c => [1, 3, 5].map(i => parseInt(c.slice(i, i + 2), 16))));
  const mix = (ramp, t) => {
    if (t === null) return [150, 150, 150];
    const x = Math.min(Math.max(t, 0), 1) * (ramp.length - 1), k = Math.min(Math.floor(x), ramp.length - 2);
    return [0, 1, 2].map(i => ramp[k][i] + (x - k) * (ramp[k + 1][i] - ramp[k][i]));
  };

  function project(points, width, height) {
    const a = eye.right * Math.PI / 180, b = eye.up * Math.PI / 180, scale = 0.46 * Math.min(width, 1.15 * height) * eye.zoom;
    const ca = Math.cos(a), sa = Math.sin(a), cb = Math.cos(b), sb = Math.sin(b);
    return points.map(p => {
      if (p === null) return null;
      const x = ca * p[0] + sa * p[2], ahead = ca * p[2] - sa * p[0];
      const y = cb * p[1] - sb * ahead, depth = sb * p[1] + cb * ahead;
      return [width / 2 + scale * x, height / 2 + scale * y, depth, x, y];
    });
  }

  function draw() {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = width * ratio; canvas.height = height * ratio;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.lineJoin = "round";
    const now = data.frames[+frame.value], kind = paint ? +paint.value : 0, ramp = ramps[kind];
    name.textContent = now.name;
    const p = project(now.points, width, height), values = now.values[kind];
    // Normals of points are the means of their triangles' by area, so that light runs smoothly over the surface.
    const normals = p.map(() => [0, 0, 0]);
    for (const t of now.triangles) {
      const [a, b, c] = t.map(i => p[i]);
      const u = [b[3] - a[3], b[4] - a[4], b[2] - a[2]], v = [c[3] - a[3], c[4] - a[4], c[2] - a[2]];
      const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      for (const i of t) for (const k of [0, 1, 2]) normals[i][k] += n[k];
    }
    const faces = now.triangles.map(t => {
      const [a, b, c] = t.map(i => p[i]);
      const n = [0, 1, 2].map(k => t.reduce((sum, i) => sum + normals[i][k] / (Math.hypot(...normals[i]) || 1), 0));
      const sign = n[2] > 0 ? -1 : 1, length = Math.hypot(...n) || 1;
      const lit = 0.45 + 0.55 * Math.max(0, sign * (-0.28 * n[0] - 0.50 * n[1] - 0.82 * n[2]) / length);
      const known = t.map(i => values[i]).filter(x => x !== null);
      const value = known.length ? known.reduce((sum, x) => sum + x, 0) / known.length : null;
      return { a, b, c, depth: a[2] + b[2] + c[2], colour: mix(ramp, value).map(x => Math.round(x * lit)) };
    }).sort((s, t) => t.depth - s.depth);
    for (const { a, b, c, colour } of faces) {
      pen.beginPath(); pen.moveTo(a[0], a[1]); pen.lineTo(b[0], b[1]); pen.lineTo(c[0], c[1]); pen.closePath();
      pen.fillStyle = pen.strokeStyle = `rgb(${colour})`;
      pen.lineWidth = 0.7; pen.fill(); pen.stroke();
    }
    if (truth && truth.checked) {
      const q = project(now.truth, width, height);
      pen.strokeStyle = getComputedStyle(document.body).color; pen.globalAlpha = 0.45; pen.lineWidth = 0.7;
      pen.beginPath();
      for (const t of now.triangles) {
        const [a, b, c] = t.map(i => q[i]);
        if (a && b && c) { pen.moveTo(a[0], a[1]); pen.lineTo(b[0], b[1]); pen.lineTo(c[0], c[1]); pen.closePath(); }
      }
      pen.stroke(); pen.globalAlpha = 1;
    }
  }

  canvas.addEventListener("pointerdown", e => { grip = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointerup", () => { grip = null; });
  canvas.addEventListener("pointercancel", () => { grip = null; });
  canvas.addEventListener("pointermove", e => {
    if (!grip) return;
    eye.right -= 0.45 * (e.clientX - grip[0]);
    eye.up = Math.min(89, Math.max(-89, eye.up + 0.45 * (e.clientY - grip[1])));
    grip = [e.clientX, e.clientY];
    draw();
  });
  canvas.addEventListener("dblclick", () => { eye = { ...start }; draw(); });
  canvas.addEventListener("wheel", e => {
    if (!e.ctrlKey) return; // a plain wheel scrolls the page
    e.preventDefault(); eye.zoom = Math.min(6, Math.max(0.4, eye.zoom * Math.exp(-0.01 * e.deltaY))); draw();
  }, { passive: false });
  for (const control of [frame, paint, truth]) if (control) control.addEventListener("input", draw);
  window.addEventListener("resize", draw);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  draw();
})();
