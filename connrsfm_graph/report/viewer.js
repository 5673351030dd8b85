// Turns the surfaces with the mouse or a finger. Triangles are filled pixel by pixel with a depth buffer; the view is
// orthographic, so that depth, colour and place in the photo are affine over a triangle.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("surfaces").textContent);
  const element = id => document.getElementById(id);
  const canvas = element("view"), pen = canvas.getContext("2d");
  const slider = element("frame"), paint = element("paint"), truth = element("truth"), photo = element("photo");
  const start = { right: 30, up: 18, zoom: 1 };
  const LIGHT = [-0.28, -0.50, -0.82];
  let eye = { ...start }, grip = null, playing = null, depth = new Float32Array(0);

  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer;
  const ramps = data.paints.map(({ ramp }) => {
    const stops = ramp.map(c => [1, 3, 5].map(i => parseInt(c.slice(i, i + 2), 16)));
    return Float32Array.from({ length: 3 * data.unknown }, (_, i) => {
      const x = Math.floor(i / 3) / (data.unknown - 1) * (stops.length - 1), k = Math.min(Math.floor(x), stops.length - 2);
      return stops[k][i % 3] + (x - k) * (stops[k + 1][i % 3] - stops[k][i % 3]);
    });
  });

  // The numbers of a frame, unpacked when it is first shown.
  function unpacked(frame) {
    if (frame.mesh) return frame.mesh;
    const places = text => text && new Int16Array(bytes(text));
    const indices = (text, points) => text && new (points.length < 3 * 65536 ? Uint16Array : Uint32Array)(bytes(text));
    const points = places(frame.points), truth = places(frame.truth);
    frame.mesh = {
      points, triangles: indices(frame.triangles, points), texture: places(frame.texture),
      values: frame.values.map(text => new Uint8Array(bytes(text))), truth, lines: indices(frame.lines, truth),
    };
    return frame.mesh;
  }

  // The pixels of a frame's photo; undefined until the browser has decoded it, then it is drawn.
  function pixels(frame) {
    if (frame.photo && frame.pixels === undefined) {
      frame.pixels = null;
      const image = new Image();
      image.onload = () => {
        const sheet = document.createElement("canvas");
        sheet.width = image.width; sheet.height = image.height;
        const context = sheet.getContext("2d", { willReadFrequently: true });
        context.drawImage(image, 0, 0);
        frame.pixels = context.getImageData(0, 0, image.width, image.height);
        draw();
      };
      image.src = frame.photo;
    }
    return frame.pixels;
  }

  // x right and y down in pixels of the canvas, z away from the viewer in the same unit.
  function project(points, width, height) {
    const a = eye.right * Math.PI / 180, b = eye.up * Math.PI / 180;
    const scale = 0.46 * Math.min(width, 1.15 * height) * eye.zoom, s = scale / data.steps;
    const ca = Math.cos(a), sa = Math.sin(a), cb = Math.cos(b), sb = Math.sin(b);
    const out = new Float32Array(points.length);
    for (let i = 0; i < points.length; i += 3) {
      const x = s * points[i], y = s * points[i + 1], z = s * points[i + 2], ahead = ca * z - sa * x;
      out[i] = width / 2 + ca * x + sa * z;
      out[i + 1] = height / 2 + cb * y - sb * ahead;
      out[i + 2] = points[i] === data.missing ? NaN : sb * y + cb * ahead;
    }
    return out;
  }

  // Brightness of every vertex; its normal is the mean of its triangles' by area, so that light runs smoothly.
  function brightness(p, triangles, ambient) {
    const normals = new Float32Array(p.length), lit = new Float32Array(p.length / 3);
    for (let t = 0; t < triangles.length; t += 3) {
      const a = 3 * triangles[t], b = 3 * triangles[t + 1], c = 3 * triangles[t + 2];
      const ux = p[b] - p[a], uy = p[b + 1] - p[a + 1], uz = p[b + 2] - p[a + 2];
      const vx = p[c] - p[a], vy = p[c + 1] - p[a + 1], vz = p[c + 2] - p[a + 2];
      const nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
      for (const i of [a, b, c]) { normals[i] += nx; normals[i + 1] += ny; normals[i + 2] += nz; }
    }
    for (let i = 0; i < lit.length; i++) {
      const x = normals[3 * i], y = normals[3 * i + 1], z = normals[3 * i + 2];
      const facing = (z > 0 ? -1 : 1) * (x * LIGHT[0] + y * LIGHT[1] + z * LIGHT[2]) / (Math.hypot(x, y, z) || 1);
      lit[i] = ambient + (1 - ambient) * Math.max(0, facing);
    }
    return lit;
  }

  // Fills `image` (ImageData) with the surface. `colour(out, w0, w1, w2, a, b, c)` sets out to red, green, blue at
  // barycentric weights of the vertices a, b, c.
  function fill(image, p, triangles, lit, colour) {
    const { width, height } = image, out = image.data, rgb = [0, 0, 0];
    if (depth.length !== width * height) depth = new Float32Array(width * height);
    depth.fill(Infinity);
    for (let t = 0; t < triangles.length; t += 3) {
      const a = triangles[t], b = triangles[t + 1], c = triangles[t + 2];
      const ax = p[3 * a], ay = p[3 * a + 1], bx = p[3 * b], by = p[3 * b + 1], cx = p[3 * c], cy = p[3 * c + 1];
      const area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
      if (!area) continue;
      const left = Math.max(0, Math.ceil(Math.min(ax, bx, cx) - 0.5)), right = Math.min(width - 1, Math.floor(Math.max(ax, bx, cx) - 0.5));
      const top = Math.max(0, Math.ceil(Math.min(ay, by, cy) - 0.5)), bottom = Math.min(height - 1, Math.floor(Math.max(ay, by, cy) - 0.5));
      const dx1 = (cy - ay) / area, dx2 = -(by - ay) / area;
      for (let y = top; y <= bottom; y++) {
        let w1 = ((left + 0.5 - ax) * (cy - ay) - (y + 0.5 - ay) * (cx - ax)) / area;
        let w2 = ((y + 0.5 - ay) * (bx - ax) - (left + 0.5 - ax) * (by - ay)) / area;
        for (let x = left; x <= right; x++, w1 += dx1, w2 += dx2) {
          const w0 = 1 - w1 - w2;
          if (w0 < -1e-6 || w1 < -1e-6 || w2 < -1e-6) continue;
          const z = w0 * p[3 * a + 2] + w1 * p[3 * b + 2] + w2 * p[3 * c + 2], at = y * width + x;
          if (z >= depth[at]) continue;
          depth[at] = z;
          colour(rgb, w0, w1, w2, a, b, c);
          const light = w0 * lit[a] + w1 * lit[b] + w2 * lit[c];
          out[4 * at] = light * rgb[0]; out[4 * at + 1] = light * rgb[1]; out[4 * at + 2] = light * rgb[2];
          out[4 * at + 3] = 255;
        }
      }
    }
  }

  function byPhoto(texture, photo) {
    const { width, height, data: source } = photo;
    return (rgb, w0, w1, w2, a, b, c) => {
      const u = (w0 * texture[2 * a] + w1 * texture[2 * b] + w2 * texture[2 * c]) / 8;
      const v = (w0 * texture[2 * a + 1] + w1 * texture[2 * b + 1] + w2 * texture[2 * c + 1]) / 8;
      const x = Math.min(Math.max(u, 0), width - 1.001), y = Math.min(Math.max(v, 0), height - 1.001);
      const i = 4 * (Math.floor(y) * width + Math.floor(x)), below = i + 4 * width, s = x % 1, t = y % 1;
      for (let k = 0; k < 3; k++) {
        rgb[k] = (1 - t) * ((1 - s) * source[i + k] + s * source[i + 4 + k]) + t * ((1 - s) * source[below + k] + s * source[below + 4 + k]);
      }
    };
  }

  function byValue(values, ramp) {
    return (rgb, w0, w1, w2, a, b, c) => {
      // Where a corner has no value, the others' is taken; grey where none has.
      const k0 = values[a] === data.unknown ? 0 : w0, k1 = values[b] === data.unknown ? 0 : w1, k2 = values[c] === data.unknown ? 0 : w2;
      const sum = k0 + k1 + k2, i = 3 * Math.round((k0 * values[a] + k1 * values[b] + k2 * values[c]) / sum);
      for (let k = 0; k < 3; k++) rgb[k] = sum > 1e-6 ? ramp[i + k] : 150;
    };
  }

  function outline(mesh, width, height) {
    const q = project(mesh.truth, width, height);
    pen.strokeStyle = getComputedStyle(document.body).color; pen.globalAlpha = 0.45; pen.lineWidth = width / canvas.clientWidth * 0.7;
    pen.beginPath();
    for (let t = 0; t < mesh.lines.length; t += 3) {
      const [a, b, c] = [0, 1, 2].map(i => 3 * mesh.lines[t + i]);
      if (Number.isNaN(q[a + 2] + q[b + 2] + q[c + 2])) continue;
      pen.moveTo(q[a], q[a + 1]); pen.lineTo(q[b], q[b + 1]); pen.lineTo(q[c], q[c + 1]); pen.closePath();
    }
    pen.stroke(); pen.globalAlpha = 1;
  }

  function draw() {
    // Two pixels of the canvas per pixel of the screen smooth the borders; one while the surface turns.
    const sharp = grip || playing ? 1 : 2, width = Math.round(canvas.clientWidth * sharp), height = Math.round(canvas.clientHeight * sharp);
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    const frame = data.frames[+slider.value], mesh = unpacked(frame), kind = +paint.value;
    element("name").textContent = frame.name;
    const legend = kind < 0 ? null : data.paints[kind];
    element("legend").innerHTML = legend ? `${legend.ends[0]} <i style="background: linear-gradient(90deg, ${legend.ramp})"></i> ${legend.ends[1]} ${legend.unit}` : "";
    if (photo && photo.src !== frame.photo) photo.src = frame.photo;
    const source = kind < 0 ? pixels(frame) : null;
    if (kind < 0 && !source) return; // drawn when the photo is there
    const p = project(mesh.points, width, height), lit = brightness(p, mesh.triangles, kind < 0 ? 0.8 : 0.45);
    const image = pen.createImageData(width, height);
    fill(image, p, mesh.triangles, lit, kind < 0 ? byPhoto(mesh.texture, source) : byValue(mesh.values[kind], ramps[kind]));
    pen.putImageData(image, 0, 0);
    if (truth && truth.checked) outline(mesh, width, height);
  }

  function play() {
    playing = playing ? clearInterval(playing) : setInterval(() => {
      slider.value = +slider.value < +slider.max ? +slider.value + 1 : 0;
      draw();
    }, 160);
    element("play").textContent = playing ? "stop" : "play";
    draw();
  }

  canvas.addEventListener("pointerdown", e => { grip = [e.clientX, e.clientY]; });
  for (const end of ["pointerup", "pointercancel"]) window.addEventListener(end, () => { if (grip) { grip = null; draw(); } });
  window.addEventListener("pointermove", e => {
    if (!grip) return;
    eye.right -= 0.45 * (e.clientX - grip[0]);
    eye.up = Math.min(89, Math.max(-89, eye.up + 0.45 * (e.clientY - grip[1])));
    grip = [e.clientX, e.clientY];
    requestAnimationFrame(draw);
  });
  canvas.addEventListener("dblclick", () => { eye = { ...start }; draw(); });
  canvas.addEventListener("wheel", e => {
    if (!e.ctrlKey) return; // a plain wheel scrolls the page
    e.preventDefault(); eye.zoom = Math.min(6, Math.max(0.4, eye.zoom * Math.exp(-0.01 * e.deltaY))); draw();
  }, { passive: false });
  for (const control of [slider, paint, truth]) if (control) control.addEventListener("input", draw);
  element("play").addEventListener("click", play);
  window.addEventListener("resize", draw);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  draw();
})();
