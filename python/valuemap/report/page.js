/* The interactive part of the report: a map on a canvas, and what a label rests on. No library, no network, no worker. */
(function () {
  "use strict";
  var head = JSON.parse(document.getElementById("data").textContent);
  var kinds = { f4: Float32Array, f8: Float64Array, i2: Int16Array, u1: Uint8Array, u2: Uint16Array, u4: Uint32Array };

  function decode(packed) {
    if (Uint8Array.fromBase64) return new kinds[packed.type](Uint8Array.fromBase64(packed.data).buffer);
    var text = atob(packed.data), bytes = new Uint8Array(text.length);
    for (var i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    return new kinds[packed.type](bytes.buffer);
  }

  var data = {}, parsed = null;
  Object.keys(head.arrays).forEach(function (name) { data[name] = decode(head.arrays[name]); });

  // What a click shows is most of a large page: read at the first click, or before it when there is nothing else to do.
  function details() {
    if (!parsed) parsed = JSON.parse(document.getElementById("details").textContent);
    return parsed;
  }
  head.detail_arrays.forEach(function (name) {
    Object.defineProperty(data, name, {
      configurable: true,
      get: function () {
        var value = decode(details().arrays[name]);
        delete details().arrays[name];
        Object.defineProperty(data, name, { value: value });
        return value;
      }
    });
  });
  function readAhead(names) {
    var soon = window.requestIdleCallback || function (work) { return setTimeout(work, 200); };
    soon(function () {
      if (!parsed) details(); else data[names.shift()];
      if (names.length) readAhead(names);
    });
  }
  var count = data.label_id.length;
  var byId = function (id) { return document.getElementById(id); };
  var map = byId("map"), panel = byId("panel"), brush = map.getContext("2d");
  var view = { x: 0, y: 0, scale: 1 };          // Middle in metres, pixels per metre.
  var chosen = -1, near = 4;                    // The label that was clicked, half width of its close views in metres.
  var style = {};

  // How the labels of a class are drawn, the most frequent first: a sign for the legend, and the corners of the mark in
  // units of its radius (none: a circle). Another shape too: in print, and to many people, colours are no difference.
  var marks = [["\u25cf"], ["\u25c6", 0, -1.3, 1.3, 0, 0, 1.3, -1.3, 0], ["\u25b2", 0, -1.3, 1.2, 0.9, -1.2, 0.9],
    ["\u25a0", -1, -1, 1, -1, 1, 1, -1, 1], ["\u25bc", 0, 1.3, 1.2, -0.9, -1.2, -0.9],
    ["\u271a", -0.5, -1.3, 0.5, -1.3, 0.5, -0.5, 1.3, -0.5, 1.3, 0.5, 0.5, 0.5, 0.5, 1.3, -0.5, 1.3, -0.5, 0.5, -1.3, 0.5, -1.3, -0.5, -0.5, -0.5],
    ["\u25ac", -1.5, -0.6, 1.5, -0.6, 1.5, 0.6, -1.5, 0.6]];

  function readStyle() {
    var css = getComputedStyle(document.documentElement);
    ["paper", "ground", "ink", "faint", "rule", "accent", "street", "street-edge", "bad", "warn", "good"].forEach(
      function (name) { style[name] = css.getPropertyValue("--" + name).trim(); });
    style.dark = isDark();
  }

  function passColor(pass) { return "hsl(" + ((pass * 137.508 + 200) % 360).toFixed(0) + " 62% 52%)"; }
  function isDark() { return !!window.matchMedia && matchMedia("(prefers-color-scheme: dark)").matches; }
  function classMark(code) { return Math.min(head.class_rank[code], marks.length - 1); }
  function classColor(code) { return head.class_colors[+style.dark][classMark(code)]; }
  function isShown(i) {
    var only = byId("class").value;
    if (only !== "" && data.label_class[i] !== +only) return false;
    return data.existence.length === 0 || data.existence[i] >= +byId("least").value;
  }

  // The map.

  function fit(canvas, context) {
    var ratio = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
    var width = Math.max(1, Math.round(box.width * ratio)), height = Math.max(1, Math.round(box.height * ratio));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    return { width: box.width, height: box.height };
  }

  var asked = false;
  function redraw() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(function () { asked = false; draw(); });
  }

  function showAll() {
    var box = map.getBoundingClientRect(), e = head.extent;
    view.x = (e[0] + e[2]) / 2; view.y = (e[1] + e[3]) / 2;
    view.scale = 0.94 * Math.min(box.width / Math.max(e[2] - e[0], 1), box.height / Math.max(e[3] - e[1], 1));
    redraw();
  }

  function lines(size, points, offsets) {
    var s = view.scale, ox = size.width / 2 - view.x * s, oy = size.height / 2 + view.y * s;
    brush.beginPath();
    for (var t = 0; t + 1 < offsets.length; t++) {
      var from = offsets[t], to = offsets[t + 1];
      for (var i = from; i < to; i++) {
        var px = ox + points[2 * i] * s, py = oy - points[2 * i + 1] * s;
        if (i === from) brush.moveTo(px, py); else brush.lineTo(px, py);
      }
    }
    brush.stroke();
  }

  function ellipse(context, px, py, i, scale) {
    var a = data.half_axes[2 * i] * scale, b = data.half_axes[2 * i + 1] * scale;
    if (!(a > 1.5) || !isFinite(a) || a > 1e5) return;
    context.beginPath();
    context.ellipse(px, py, a, Math.max(b, 0.5), -data.angle[i], 0, 2 * Math.PI);
    context.globalAlpha = 0.18; context.fill();
    context.globalAlpha = 0.85; context.stroke();
    context.globalAlpha = 1;
  }

  function draw() {
    var size = fit(map, brush), s = view.scale;
    var ox = size.width / 2 - view.x * s, oy = size.height / 2 + view.y * s, i, px, py;
    brush.fillStyle = style.ground;
    brush.fillRect(0, 0, size.width, size.height);
    brush.lineCap = "round"; brush.lineJoin = "round";
    var street = Math.min(Math.max(9 * s, 2), 400);
    [[style["street-edge"], street + 2], [style.street, street]].forEach(function (layer) {
      brush.strokeStyle = layer[0]; brush.lineWidth = layer[1];
      lines(size, data.drive_points, data.drive_offsets);
    });
    if (s > 1) {
      brush.strokeStyle = style.rule; brush.lineWidth = 1;
      lines(size, data.drive_points, data.drive_offsets.subarray(0, head.drives + 1));
    }
    if (chosen >= 0) drawRays(ox, oy, s);
    for (i = 0; i < data.object_outcome.length; i++) {
      px = ox + data.object_at[2 * i] * s; py = oy - data.object_at[2 * i + 1] * s;
      if (px < -20 || py < -20 || px > size.width + 20 || py > size.height + 20) continue;
      var half = Math.min(8, Math.max(2.2, 2 + 4 * s));
      brush.strokeStyle = [style.good, style.bad, style.faint][data.object_outcome[i]];
      brush.lineWidth = half < 4 ? 1 : data.object_outcome[i] === 1 ? 2.5 : 1.5;
      brush.beginPath();
      if (data.object_outcome[i] === 0) brush.arc(px, py, half, 0, 2 * Math.PI);
      else brush.rect(px - half, py - half, 2 * half, 2 * half);
      brush.stroke();
    }
    var radius = Math.min(4.5, Math.max(1.6, 1.4 + s)), arm = Math.min(6, Math.max(2.5, 2 + 3 * s));
    for (i = 0; i < count; i++) {
      px = ox + data.label_at[3 * i] * s; py = oy - data.label_at[3 * i + 1] * s;
      if (px < -60 || py < -60 || px > size.width + 60 || py > size.height + 60 || !isShown(i)) continue;
      brush.fillStyle = brush.strokeStyle = data.is_gone[i] ? style.faint : classColor(data.label_class[i]);
      brush.lineWidth = 1;
      ellipse(brush, px, py, i, s);
      if (data.is_gone[i]) {                     // Another shape too, and thinner than what is false.
        brush.strokeStyle = style.faint; brush.lineWidth = 1.4;
        brush.beginPath();
        brush.moveTo(px - radius, py - radius); brush.lineTo(px + radius, py + radius);
        brush.moveTo(px + radius, py - radius); brush.lineTo(px - radius, py + radius);
      } else {
        trace(px, py, radius, marks[classMark(data.label_class[i])]); brush.fill();
        brush.strokeStyle = style.paper; brush.lineWidth = 0.8;
      }
      brush.stroke();
      var outcome = data.label_outcome.length ? data.label_outcome[i] : 2;
      if (outcome < 2) { // Neither true nor gone.
        brush.strokeStyle = outcome === 1 ? style.bad : style.warn; brush.lineWidth = arm < 4 ? 1.2 : 2.5;
        brush.beginPath();
        if (outcome === 1) {
          brush.moveTo(px - arm, py - arm); brush.lineTo(px + arm, py + arm);
          brush.moveTo(px + arm, py - arm); brush.lineTo(px - arm, py + arm);
        } else {                                 // Another shape too: in print there are no colours.
          brush.moveTo(px, py - 1.6 * arm); brush.lineTo(px + 1.5 * arm, py + arm); brush.lineTo(px - 1.5 * arm, py + arm);
          brush.closePath();
        }
        brush.stroke();
      }
      if (i === chosen) {
        brush.strokeStyle = style.ink; brush.lineWidth = 2;
        brush.beginPath(); brush.arc(px, py, 12, 0, 2 * Math.PI); brush.stroke();
      }
    }
    scaleBar(brush, size, s);
  }

  function trace(px, py, radius, mark) {
    brush.beginPath();
    if (mark.length === 1) { brush.arc(px, py, radius, 0, 2 * Math.PI); return; }
    for (var c = 1; c < mark.length; c += 2) brush.lineTo(px + mark[c] * radius, py + mark[c + 1] * radius);
    brush.closePath();
  }

  function drawRays(ox, oy, s) {
    var x = ox + data.label_at[3 * chosen] * s, y = oy - data.label_at[3 * chosen + 1] * s;
    brush.lineWidth = 1;
    for (var v = data.vote_start[chosen]; v < data.vote_start[chosen + 1]; v++) {
      var image = data.vote_image[v], px = ox + data.camera_at[3 * image] * s, py = oy - data.camera_at[3 * image + 1] * s;
      brush.strokeStyle = brush.fillStyle = passColor(data.camera_pass[image]);
      brush.globalAlpha = 0.55;
      brush.beginPath(); brush.moveTo(px, py); brush.lineTo(x, y); brush.stroke();
      brush.globalAlpha = 1;
      brush.beginPath(); brush.arc(px, py, 2.5, 0, 2 * Math.PI); brush.fill();
    }
  }

  function scaleBar(context, size, scale) {
    var most = 0.25 * size.width / scale, power = Math.pow(10, Math.floor(Math.log10(most)));
    var length = [5, 2, 1].map(function (f) { return f * power; }).filter(function (l) { return l <= most; })[0];
    var right = size.width - 14, y = size.height - 12;
    context.strokeStyle = style.ink; context.fillStyle = style.ink; context.lineWidth = 2;
    context.beginPath(); context.moveTo(right - length * scale, y); context.lineTo(right, y); context.stroke();
    context.font = "12px system-ui, sans-serif"; context.textAlign = "center";
    context.fillText(length >= 1000 ? length / 1000 + " km" : +length.toPrecision(1) + " m", right - length * scale / 2, y - 5);
  }

  // Moving about.

  function zoomAt(px, py, factor) {
    var box = map.getBoundingClientRect();
    var x = view.x + (px - box.width / 2) / view.scale, y = view.y - (py - box.height / 2) / view.scale;
    view.scale = Math.min(Math.max(view.scale * factor, 1e-4), 5000);
    view.x = x - (px - box.width / 2) / view.scale;
    view.y = y + (py - box.height / 2) / view.scale;
    redraw();
  }

  map.addEventListener("wheel", function (event) {
    event.preventDefault();
    zoomAt(event.offsetX, event.offsetY, Math.pow(1.0016, -event.deltaY * (event.deltaMode === 1 ? 30 : 1)));
  }, { passive: false });

  var fingers = new Map(), moved = 0;
  map.addEventListener("pointerdown", function (event) {
    map.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
    if (fingers.size === 1) moved = 0;
  });
  map.addEventListener("pointermove", function (event) {
    if (!fingers.has(event.pointerId)) return;
    var before = fingers.get(event.pointerId), dx = event.offsetX - before[0], dy = event.offsetY - before[1];
    if (fingers.size === 2) {
      var other = Array.from(fingers.entries()).filter(function (f) { return f[0] !== event.pointerId; })[0][1];
      var old = Math.hypot(before[0] - other[0], before[1] - other[1]);
      zoomAt(other[0], other[1], Math.hypot(event.offsetX - other[0], event.offsetY - other[1]) / Math.max(old, 1));
      moved += 10;
    } else {
      moved += Math.abs(dx) + Math.abs(dy);
      view.x -= dx / view.scale; view.y += dy / view.scale;
      redraw();
    }
    fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
  });
  map.addEventListener("pointerup", function (event) {
    fingers.delete(event.pointerId);
    if (moved < 6 && fingers.size === 0) pick(event.offsetX, event.offsetY);
  });
  map.addEventListener("pointercancel", function (event) { fingers.delete(event.pointerId); });
  map.addEventListener("keydown", function (event) {
    var box = map.getBoundingClientRect(), step = 60 / view.scale, key = event.key;
    if (key === "+" || key === "=") zoomAt(box.width / 2, box.height / 2, 1.4);
    else if (key === "-") zoomAt(box.width / 2, box.height / 2, 1 / 1.4);
    else if (key === "0") showAll();
    else if (key === "ArrowLeft") view.x -= step;
    else if (key === "ArrowRight") view.x += step;
    else if (key === "ArrowUp") view.y += step;
    else if (key === "ArrowDown") view.y -= step;
    else if (key === "n" || key === "p") { choose((chosen + (key === "n" ? 1 : count - 1)) % Math.max(count, 1), true); }
    else return;
    event.preventDefault();
    redraw();
  });

  function pick(px, py) {
    var box = map.getBoundingClientRect(), best = -1, least = 16;
    for (var i = 0; i < count; i++) {
      if (!isShown(i)) continue;
      var x = box.width / 2 + (data.label_at[3 * i] - view.x) * view.scale;
      var y = box.height / 2 - (data.label_at[3 * i + 1] - view.y) * view.scale;
      var distance = Math.hypot(x - px, y - py);
      if (distance < least) { least = distance; best = i; }
    }
    choose(best, false);
  }

  // One label.

  function element(name, text, parent) {
    var made = document.createElement(name);
    if (text !== undefined) made.textContent = text;
    if (parent) parent.appendChild(made);
    return made;
  }

  function choose(i, center) {
    chosen = i;
    panel.textContent = "";
    if (i < 0) { element("p", head.invitation, panel).className = "note"; redraw(); return; }
    if (center) {
      view.x = data.label_at[3 * i]; view.y = data.label_at[3 * i + 1];
      view.scale = Math.max(view.scale, 8);
    }
    element("h3", "Label " + data.label_id[i] + ": " + head.classes[data.label_class[i]], panel);
    if (data.is_gone[i]) element("p", "Gone: an update found nothing here any more.", panel);
    var facts = element("dl", undefined, panel);
    function fact(name, value) { element("dt", name, facts); element("dd", value, facts); }
    var at = [0, 1, 2].map(function (axis) { return (data.label_at[3 * i + axis] + head.origin[axis]).toFixed(2); });
    fact(head.axis_names.join(", ") + ", up (m)", at.join(", "));
    if (data.lon_lat.length) fact("lon, lat", data.lon_lat[2 * i].toFixed(7) + ", " + data.lon_lat[2 * i + 1].toFixed(7));
    fact("95 % ellipse, half axes", data.half_axes[2 * i].toFixed(3) + " x " + data.half_axes[2 * i + 1].toFixed(3) + " m");
    fact("sigma of the height", data.up_sigma[i].toFixed(3) + " m");
    if (data.label_state.length) fact("state", head.states[data.label_state[i]]);
    if (data.existence.length) fact("existence", data.existence[i] > 0.9995 ? "> 0.999" : data.existence[i].toFixed(3));
    var expected = data.expected.length ? " of " + data.expected[i] + " images that should have seen it" : " images";
    fact("votes", data.votes[i] + expected);
    fact("passes", String(data.passes[i]));
    fact("reprojection rms", data.rms[i].toFixed(2) + " px");
    if (data.label_outcome.length) {
      var outcome = head.outcomes[data.label_outcome[i]];
      fact("against the truth", outcome + (isFinite(data.error[i]) ? ", " + data.error[i].toFixed(3) + " m off" : ""));
    }
    showCrops(i);
    if (data.vote_image.length) showRays(i);
    showVotes(i);
    redraw();
  }

  function showCrops(i) {
    var listed = document.querySelector('.crops[data-label="' + i + '"]');
    if (listed) { panel.appendChild(listed.cloneNode(true)); return; }
    if (!details().crops[i]) return;
    var crops = element("div", undefined, panel);
    crops.className = "crops";
    details().crops[i].forEach(function (crop) {
      var figure = element("figure", undefined, crops), picture = element("img", undefined, figure);
      picture.src = "data:image/jpeg;base64," + crop[0];
      picture.alt = crop[1];
      element("figcaption", crop[1], figure);
    });
  }

  function showRays(i) {
    var label = element("label", "rays, width of the view", panel), slider = element("input", undefined, label);
    slider.type = "range"; slider.min = -2; slider.max = 4.5; slider.step = 0.05;
    var widest = Math.max(data.half_axes[2 * i], data.up_sigma[i] * 2.45);
    near = isFinite(widest) && widest > 0 ? Math.min(Math.max(4 * widest, 0.3), 40) : 4;
    slider.value = Math.log(near);
    element("div", "From above", panel).className = "note";
    var above = element("canvas", undefined, panel);
    element("div", "From the side, along the mean direction of looking", panel).className = "note";
    var side = element("canvas", undefined, panel);
    [above, side].forEach(function (canvas, k) {
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", (k ? "Side view" : "View from above") + " of the rays that vote for this label");
    });
    function both() { near = Math.exp(+slider.value); closeUp(above, i, false); closeUp(side, i, true); }
    slider.addEventListener("input", both);
    both();
  }

  function closeUp(canvas, i, fromSide) {
    var context = canvas.getContext("2d"), size = fit(canvas, context), scale = size.width / (2 * near);
    context.fillStyle = style.ground; context.fillRect(0, 0, size.width, size.height);
    var begin = data.vote_start[i], end = data.vote_start[i + 1], v, mx = 0, my = 0;
    for (v = begin; v < end; v++) { mx += data.vote_direction[3 * v]; my += data.vote_direction[3 * v + 1]; }
    var length = Math.hypot(mx, my) || 1; mx /= length; my /= length;
    function across(dx, dy, dz) { return fromSide ? [dx * mx + dy * my, dz] : [dx, dy]; }
    var cx = size.width / 2, cy = size.height / 2;
    for (v = begin; v < end; v++) {
      var image = data.vote_image[v];
      var o = across(data.camera_at[3 * image] - data.label_at[3 * i], data.camera_at[3 * image + 1] - data.label_at[3 * i + 1],
        data.camera_at[3 * image + 2] - data.label_at[3 * i + 2]);
      var d = across(data.vote_direction[3 * v], data.vote_direction[3 * v + 1], data.vote_direction[3 * v + 2]);
      var reach = (Math.hypot(o[0], o[1]) + 4 * near) / (Math.hypot(d[0], d[1]) || 1);
      context.strokeStyle = passColor(data.camera_pass[image]);
      context.globalAlpha = 0.6; context.lineWidth = 1;
      context.beginPath();
      context.moveTo(cx + o[0] * scale, cy - o[1] * scale);
      context.lineTo(cx + (o[0] + d[0] * reach) * scale, cy - (o[1] + d[1] * reach) * scale);
      context.stroke();
    }
    context.globalAlpha = 1;
    context.strokeStyle = context.fillStyle = style.accent; context.lineWidth = 1.5;
    if (fromSide) {
      var cos = mx * Math.cos(data.angle[i]) + my * Math.sin(data.angle[i]);
      var along = Math.hypot(data.half_axes[2 * i] * cos, data.half_axes[2 * i + 1] * Math.sqrt(Math.max(0, 1 - cos * cos)));
      context.beginPath();
      context.ellipse(cx, cy, along * scale, data.up_sigma[i] * 2.4477 * scale, 0, 0, 2 * Math.PI);
      context.globalAlpha = 0.25; context.fill(); context.globalAlpha = 1; context.stroke();
    } else ellipse(context, cx, cy, i, scale);
    context.fillStyle = style.ink;
    context.beginPath(); context.arc(cx, cy, 3, 0, 2 * Math.PI); context.fill();
    scaleBar(context, size, scale);
  }

  function showVotes(i) {
    var begin = data.vote_start[i], end = data.vote_start[i + 1];
    if (begin === end) return;
    var table = element("table", undefined, panel), row = element("tr", undefined, element("thead", undefined, table));
    ["image", "pass", "m", "px", "sigmas"].forEach(function (name) { element("th", name, row).scope = "col"; });
    var body = element("tbody", undefined, table), most = Math.min(end, begin + 300);
    for (var v = begin; v < most; v++) {
      row = element("tr", undefined, body);
      var image = data.vote_image[v];
      element("td", details().image_names.length ? details().image_names[image] : "row " + data.camera_row[image], row);
      element("td", details().passes[data.camera_pass[image]], row).style.color = passColor(data.camera_pass[image]);
      var away = Math.hypot(data.camera_at[3 * image] - data.label_at[3 * i],
        data.camera_at[3 * image + 1] - data.label_at[3 * i + 1], data.camera_at[3 * image + 2] - data.label_at[3 * i + 2]);
      element("td", away.toFixed(1), row);
      element("td", data.vote_px[v].toFixed(2), row);
      element("td", data.vote_sigmas[v].toFixed(2), row);
    }
    if (most < end) element("p", "and " + (end - most) + " more: see votes.parquet", panel).className = "note";
  }

  // Tools.

  function chooseNamed() {                      // A link to report.html#label=12 opens with that label.
    var named = /^#label=(\d+)$/.exec(location.hash);
    for (var i = 0; named && i < count; i++) if (String(data.label_id[i]) === named[1]) { choose(i, true); return; }
  }

  // What the map shows, and nothing that it does not.
  function legend() {
    var box = byId("legend"), there = { label: {}, object: {}, "class": {}, gone: {} };
    for (var i = 0; i < count; i++) there[data.is_gone[i] ? "gone" : "class"][data.label_class[i]] = true;
    data.label_outcome.forEach(function (code) { there.label[code] = true; });
    data.object_outcome.forEach(function (code) { there.object[code] = true; });
    function entry(sign, text) {
      var made = element("span", undefined, box), mark = element("b", sign, made);
      made.appendChild(document.createTextNode(text));
      return mark;
    }
    box.textContent = "";
    var codes = Object.keys(there["class"]).map(Number), others = 0;
    codes.sort(function (a, b) { return head.class_rank[a] - head.class_rank[b]; });
    codes.forEach(function (code) {
      if (codes.length > marks.length && head.class_rank[code] >= marks.length - 1) { others += 1; return; }
      entry(marks[classMark(code)][0], head.classes[code]).style.color = classColor(code);
    });
    if (others) entry(marks[marks.length - 1][0], others + " other classes").style.color = head.class_colors[+style.dark][marks.length - 1];
    if (Object.keys(there.gone).length) entry("\u00d7", "label, gone").className = "unsure";
    [["object", 0, "\u25cb", "true object, found", "good"], ["object", 1, "\u25a1", "true object, missed", "bad"],
      ["object", 2, "\u25ab", "true object, not recoverable", "unsure"], ["label", 1, "\u2715", "false label", "bad"],
      ["label", 0, "\u25b3", "duplicate", "warn"]].forEach(function (mark) {
      if (there[mark[0]][mark[1]]) entry(mark[2], mark[3]).className = mark[4];
    });
  }

  function setUp() {
    readStyle();
    byId("explore").hidden = false;
    byId("static-map").hidden = true;
    head.classes.forEach(function (name, code) { element("option", name, byId("class")).value = code; });
    byId("class").addEventListener("change", redraw);
    byId("least").addEventListener("input", function () { byId("least-value").textContent = (+byId("least").value).toFixed(2); redraw(); });
    if (!data.existence.length) byId("least").parentNode.hidden = true;
    byId("all").addEventListener("click", showAll);
    byId("search").addEventListener("change", function () {
      for (var i = 0; i < count; i++) if (String(data.label_id[i]) === byId("search").value.trim()) { choose(i, true); return; }
      panel.textContent = ""; element("p", "There is no label " + byId("search").value, panel);
    });
    document.querySelectorAll("button[data-show]").forEach(function (button) {
      button.hidden = false;
      button.addEventListener("click", function () {
        choose(+button.getAttribute("data-show"), true);
        byId("explore").scrollIntoView({ block: "start" });
      });
    });
    legend();
    if (window.ResizeObserver) new ResizeObserver(redraw).observe(map); else window.addEventListener("resize", redraw);
    if (window.matchMedia) matchMedia("(prefers-color-scheme: dark)").addEventListener("change", function () { readStyle(); legend(); choose(chosen, false); });
    choose(-1, false);
    showAll();
    chooseNamed();
    window.addEventListener("hashchange", chooseNamed);
    document.documentElement.setAttribute("data-ready", String(count));
    if (window.performance && performance.mark) performance.mark("valuemap:ready");
    readAhead(head.detail_arrays.slice());
  }

  setUp();
})();
