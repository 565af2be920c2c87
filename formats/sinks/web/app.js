// Page of a live session: a map on a canvas, a table of the devices, events and health.
// All texts from the session are shown with textContent or fillText, never as HTML.
"use strict";
(function () {
  const OLD_S = 2;              // Age from which a pose is shown as old.
  const SILENCE_S = 3.5;        // The server sends at least each second.
  const TRAIL_STEP_S = 0.1;
  const MAX_TRAIL_S = 60;
  const MAX_EVENTS = 200;
  const MAX_RETRY_S = 5;
  const TABLE_INTERVAL_MS = 200;
  const TRAIL_REFRESH_MS = 2000;
  const COLOR_COUNT = 21;
  const STATES = ["tracking", "provisional", "dead reckoning", "lost"];
  const CHIPS = {
    "tracking": "good", "provisional": "fair", "dead reckoning": "carried", "lost": "bad",
  };
  const ELLIPSE_95 = Math.sqrt(5.991);  // Chi-square of two degrees of freedom.

  const $ = (id) => document.getElementById(id);
  const canvas = $("canvas"), context = canvas.getContext("2d");
  const token = new URLSearchParams(location.hash.slice(1)).get("token") || "";

  const devices = new Map();
  let artifact = { unit: "m", frames: {} }, artifactPaths = {};
  let connection = "connecting", lostSince = null, lastMessage = 0, retry_s = 0.5;
  let colors = {};
  let dirty = true, tableDue = 0;
  let version = 0;  // Increases when the artifact or the colors change.
  const view = { x: 0, y: 0, scale: 100, plane: 1, frame: "", follow: "", auto: true,
                 labels: true, trail_s: 30, cursor: null, isFrameChosen: false };

  // ---- messages

  function connect() {
    const url = new URL("ws", location.href.split("#")[0].replace(/[^/]*$/, ""));
    url.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    if (token) url.searchParams.set("token", token);
    const socket = new WebSocket(url);
    let closed = false;
    lastMessage = performance.now();
    const watchdog = setInterval(() => {
      if (performance.now() - lastMessage > 1000 * SILENCE_S) ended();
    }, 250);
    function ended() {
      if (closed) return;
      closed = true;
      clearInterval(watchdog);
      socket.close();
      setConnection("lost");
      setTimeout(connect, 1000 * retry_s);
      retry_s = Math.min(MAX_RETRY_S, 2 * retry_s);
    }
    socket.onmessage = (event) => {
      if (closed) return;
      lastMessage = performance.now();
      receive(JSON.parse(event.data));
    };
    socket.onclose = ended;
  }

  function receive(message) {
    if (message.type === "hello") hello(message);
    else if (message.type === "artifact") setArtifact(message);
    else if (message.type === "health") setHealth(message);
    else if (message.type === "update") message.messages.forEach(take);
    dirty = true;
  }

  function hello(message) {
    version++;
    for (const device of devices.values()) device.row.remove();
    devices.clear();
    $("events").replaceChildren();
    $("system").textContent = message.system;
    for (const name of message.names) deviceOf(name);
    for (const known of message.devices) {
      const device = deviceOf(known.device);
      for (const [t, x, y, z, state, reset, frame] of known.trail) {
        device.trail.push({ t, x, y, z, state: STATES[state], reset, frame });
        device.appended++;
      }
      if (known.pose) takePose(known.pose, known.age_s);
      if (known.detection) device.detection = describeDetection(known.detection.detection);
      if (known.state) takeState(known.state);
    }
    for (const event of message.events) addEvent(event);
    retry_s = 0.5;
    setConnection("live");
  }

  function take(message) {
    if (message.type === "pose") {
      takePose(message, 0);
      return;
    }
    if (message.type === "state") takeState(message);
    if (message.type === "detection") {
      deviceOf(message.device).detection = describeDetection(message.detection);
    }
    addEvent(message);
  }

  function remove(device) {
    devices.delete(device.name);
    device.row.remove();
    for (const option of Array.from($("follow").options)) {
      if (option.value === device.name) option.remove();
    }
  }

  function deviceOf(name) {
    let device = devices.get(name);
    if (device) return device;
    let index = devices.size;
    // The devices behind a port, such as the robots of a gateway, replace its name.
    for (const other of devices.values()) {
      if (!other.pose && !other.state && name.startsWith(other.name + "-")) {
        index = other.index;
        remove(other);
      }
    }
    device = { name, index, pose: null, received: -Infinity, state: "", reason: "",
               stateTime: -Infinity, detection: "", rate: null, latency: null, trail: [],
               appended: 0, painted: 0 };
    device.row = newRow(device);
    devices.set(name, device);
    $("rows").append(device.row);
    const option = document.createElement("option");
    option.value = name;
    option.textContent = "Follow " + name;
    if (!Array.from($("follow").options).some((each) => each.value === name)) $("follow").append(option);
    return device;
  }

  function takePose(pose, age_s) {
    const device = deviceOf(pose.device);
    device.pose = pose;
    device.received = performance.now() - 1000 * (age_s || 0);
    device.state = pose.state;
    device.reason = pose.reason;
    device.stateTime = pose.time_s;
    if (pose.latency_s != null) {
      device.latency = device.latency == null ? pose.latency_s
        : device.latency + 0.1 * (pose.latency_s - device.latency);
    }
    const trail = device.trail, last = trail[trail.length - 1];
    // If the clock was set, or a replay began again.
    const isBack = last && pose.time_s < last.t - 0.01;
    if (isBack) trail.length = 0;
    if (!last || isBack || pose.time_s - last.t >= TRAIL_STEP_S ||
        pose.state !== last.state || pose.reset_counter !== last.reset || pose.frame !== last.frame) {
      trail.push({ t: pose.time_s, x: pose.x_m, y: pose.y_m, z: pose.z_m, state: pose.state,
                   reset: pose.reset_counter, frame: pose.frame });
      device.appended++;
    }
    let old = 0;
    while (old < trail.length && trail[old].t < pose.time_s - MAX_TRAIL_S) old++;
    if (old > 50) trail.splice(0, old);
    if (pose.frame !== view.frame && (device.name === view.follow || isFrameEmpty())) setFrame(pose.frame);
  }

  // Whether no device is in the frame of the map, which the user has not chosen.
  function isFrameEmpty() {
    return !view.isFrameChosen &&
      ![...devices.values()].some((each) => each.pose && each.pose.frame === view.frame);
  }

  function takeState(message) {
    const device = deviceOf(message.device);
    if (message.time_s < device.stateTime) return;
    device.state = message.state;
    device.reason = message.reason;
    device.stateTime = message.time_s;
  }

  function setConnection(state) {
    if (state === "lost" && connection !== "lost") lostSince = new Date();
    connection = state;
    document.body.dataset.connection = state;
    const chip = $("connection");
    chip.textContent = { live: "live", lost: "connection lost", connecting: "connecting" }[state];
    chip.className = "chip " + { live: "good", lost: "bad", connecting: "" }[state];
    const banner = $("banner");
    banner.hidden = state !== "lost";
    if (state === "lost") {
      $("health").hidden = true;
      $("facts").replaceChildren(element("dt", "", "unknown without a connection"), element("dd"));
      for (const device of devices.values()) device.rate = device.latency = null;
      banner.textContent = "Connection lost at " + clock(lostSince) +
        ". All positions are old. Trying again until locatk live answers" +
        (token ? "; after a restart it prints a new address." : ".");
    }
    dirty = true;
    tableDue = 0;
  }

  // ---- artifact

  function setArtifact(message) {
    artifact = message;
    artifactPaths = {};
    version++;
    const frames = Object.keys(artifact.frames);
    const select = $("frame");
    select.replaceChildren(...frames.map((frame) => {
      const option = document.createElement("option");
      option.value = frame;
      option.textContent = "Frame " + frame;
      return option;
    }));
    select.hidden = frames.length < 2;
    if (!frames.includes(view.frame) && frames.length) setFrame(frames[0]);
    select.value = view.frame;
  }

  function setFrame(frame) {
    if (frame === view.frame) return;
    view.frame = frame;
    view.auto = true;
    $("frame").value = frame;
    dirty = true;
  }

  function shapesOf() {
    const frame = artifact.frames[view.frame];
    return frame ? frame.shapes : [];
  }

  // Path of lines or polygons in metres; drawing transforms it.
  function pathOf(shape, index) {
    const key = view.frame + "/" + index;
    if (!artifactPaths[key]) {
      const path = new Path2D();
      for (const element of shape.points) {
        element.forEach((point, k) => (k ? path.lineTo(point[0], point[1]) : path.moveTo(point[0], point[1])));
        if (shape.kind === "polygon") path.closePath();
      }
      artifactPaths[key] = path;
    }
    return artifactPaths[key];
  }

  // ---- view

  const height = (point) => (point.length > 2 ? point[2] : 0);
  const toScreen = (x, y, z) => [
    size.width / 2 + (x - view.x) * view.scale,
    size.height / 2 - ((view.plane === 1 ? y : z) - view.y) * view.scale,
  ];
  const size = { width: 1, height: 1, ratio: 1 };

  function resize() {
    const box = canvas.getBoundingClientRect(), ratio = window.devicePixelRatio || 1;
    size.width = Math.max(1, box.width);
    size.height = Math.max(1, box.height);
    size.ratio = ratio;
    canvas.width = Math.round(size.width * ratio);
    canvas.height = Math.round(size.height * ratio);
    if (view.auto) fit();
    dirty = true;
  }

  function bounds() {
    let low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    const add = (x, y, z) => {
      const v = view.plane === 1 ? y : z;
      if (!Number.isFinite(x) || !Number.isFinite(v)) return;
      low = [Math.min(low[0], x), Math.min(low[1], v)];
      high = [Math.max(high[0], x), Math.max(high[1], v)];
    };
    for (const shape of shapesOf()) {
      for (const element of shape.points) {
        const own = shape.kind === "station" ? element.slice(0, 1) : element;
        for (const point of own) add(point[0], point[1], height(point));
      }
    }
    for (const { pose } of devices.values()) {
      if (pose && pose.frame === view.frame) add(pose.x_m, pose.y_m, pose.z_m);
    }
    return low[0] <= high[0] ? { low, high } : null;
  }

  const MARGIN = { left: 72, right: 64, top: 68, bottom: 60 };

  function fit() {
    const box = bounds();
    if (!box) return;
    const width = Math.max(box.high[0] - box.low[0], 0.1), tall = Math.max(box.high[1] - box.low[1], 0.1);
    const inner = [Math.max(50, size.width - MARGIN.left - MARGIN.right),
                   Math.max(50, size.height - MARGIN.top - MARGIN.bottom)];
    view.scale = Math.min(inner[0] / width, inner[1] / tall);
    view.x = (box.low[0] + box.high[0]) / 2 + (MARGIN.right - MARGIN.left) / 2 / view.scale;
    view.y = (box.low[1] + box.high[1]) / 2 + (MARGIN.top - MARGIN.bottom) / 2 / view.scale;
  }

  // Fit again as long as the user has not chosen a view, but only if something would be outside.
  function fitIfNeeded() {
    const box = bounds();
    if (!box) return;
    const [left, bottom] = toScreen(box.low[0], box.low[1], box.low[1]);
    const [right, top] = toScreen(box.high[0], box.high[1], box.high[1]);
    const tooSmall = right - left < 0.4 * size.width && bottom - top < 0.4 * size.height &&
      Math.max(box.high[0] - box.low[0], box.high[1] - box.low[1]) > 0.1;
    if (left < 20 || top < 50 || right > size.width - 20 || bottom > size.height - 30 || tooSmall) fit();
  }

  function zoom(factor, x, y) {
    if (x === undefined || view.follow) [x, y] = [size.width / 2, size.height / 2];
    const before = fromScreen(x, y);
    view.scale = Math.min(1e6, Math.max(0.01, view.scale * factor));
    const after = fromScreen(x, y);
    view.x += before[0] - after[0];
    view.y += before[1] - after[1];
    view.auto = false;
    dirty = true;
  }

  function pan(dx, dy) {
    view.x -= dx / view.scale;
    view.y += dy / view.scale;
    view.auto = false;
    follow("");
    dirty = true;
  }

  const fromScreen = (x, y) => [
    view.x + (x - size.width / 2) / view.scale,
    view.y - (y - size.height / 2) / view.scale,
  ];

  function follow(name) {
    if (name === view.follow) return;
    view.follow = name;
    $("follow").value = name;
    const device = devices.get(name);
    if (device && device.pose) setFrame(device.pose.frame);
    if (name) view.auto = false;
    for (const each of devices.values()) {
      const followed = each.name === name;
      each.row.classList.toggle("followed", followed);
      each.cells.button.setAttribute("aria-pressed", String(followed));
    }
    dirty = true;
  }

  // ---- drawing

  function readColors() {
    const style = getComputedStyle(document.documentElement);
    colors = new Proxy({}, {
      get(cache, name) {
        if (!(name in cache)) cache[name] = style.getPropertyValue("--" + name).trim() || "#888";
        return cache[name];
      },
    });
    version++;
    dirty = true;
  }

  const colorOf = (device) => colors["d" + (device.index % COLOR_COUNT)];
  const isOld = (device, now) => connection !== "live" || now - device.received > 1000 * OLD_S;

  function niceStep(pixels) {
    const least = pixels / view.scale, power = Math.pow(10, Math.floor(Math.log10(least)));
    return power * ([1, 2, 5, 10].find((factor) => factor * power >= least * 0.999) || 10);
  }

  const decimalsOf = (step) => Math.max(0, Math.min(6, -Math.floor(Math.log10(step) + 1e-9)));

  // Pictures of what changes seldom, PAD pixels larger than the map on all sides: if the view moves
  // (also when it follows a device), they are moved, and drawn again only beyond that.
  const PAD = 120;
  const newLayer = () => ({ canvas: document.createElement("canvas"), key: "", x: 0, y: 0, painted: 0 });
  const ground = newLayer(), trails = newLayer();

  function onLayer(layer, paint) {
    const c = layer.canvas.getContext("2d"), { x, y } = view;
    [view.x, view.y] = [layer.x, layer.y];
    c.setTransform(size.ratio, 0, 0, size.ratio, PAD * size.ratio, PAD * size.ratio);
    paint(c);
    [view.x, view.y] = [x, y];
  }

  // Draw a layer on the map. Return whether it was painted again.
  function drawLayer(layer, key, paint) {
    const offset = () => [(layer.x - view.x) * view.scale, (view.y - layer.y) * view.scale];
    const all = [key, view.scale, view.plane, view.frame, size.width, size.height, size.ratio].join(" ");
    const isNew = layer.key !== all || offset().some((each) => Math.abs(each) > PAD);
    if (isNew) {
      Object.assign(layer, { key: all, x: view.x, y: view.y });
      layer.canvas.width = canvas.width + 2 * Math.round(PAD * size.ratio);
      layer.canvas.height = canvas.height + 2 * Math.round(PAD * size.ratio);
      onLayer(layer, paint);
    }
    const [x, y] = offset();
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.drawImage(layer.canvas, Math.round((x - PAD) * size.ratio), Math.round((y - PAD) * size.ratio));
    context.setTransform(size.ratio, 0, 0, size.ratio, 0, 0);
    return isNew;
  }

  function paintGround(c) {
    c.fillStyle = colors.card;
    c.fillRect(-PAD, -PAD, size.width + 2 * PAD, size.height + 2 * PAD);
    drawGrid(c);
    if (view.plane === 1) drawGround(c);
    drawMarks(c);
    if (view.labels) drawArtifactLabels(c);
  }

  function ticksBetween(low, high, step) {
    const ticks = [];
    for (let k = Math.ceil(low / step); k <= high / step; k++) ticks.push(k * step);
    return ticks;
  }

  function drawGrid(c) {
    const step = niceStep(85);
    const [left, top] = fromScreen(-PAD, -PAD), [right, bottom] = fromScreen(size.width + PAD, size.height + PAD);
    c.lineWidth = 1;
    for (const value of ticksBetween(left, right, step)) {
      const x = Math.round(size.width / 2 + (value - view.x) * view.scale) + 0.5;
      c.strokeStyle = Math.abs(value) < step / 2 ? colors.rule : colors.grid;
      line(c, x, -PAD, x, size.height + PAD);
    }
    for (const value of ticksBetween(bottom, top, step)) {
      const y = Math.round(size.height / 2 - (value - view.y) * view.scale) + 0.5;
      c.strokeStyle = Math.abs(value) < step / 2 ? colors.rule : colors.grid;
      line(c, -PAD, y, size.width + PAD, y);
    }
  }

  function drawTicks(c) {
    const unit = artifact.unit === "unit" ? "units" : "m";
    const step = niceStep(85), decimals = decimalsOf(step);
    const [left, top] = fromScreen(46, 74), [right, bottom] = fromScreen(size.width - 50, size.height - 24);
    c.font = "11px system-ui, sans-serif";
    c.textBaseline = "alphabetic";
    c.textAlign = "center";
    for (const value of ticksBetween(left, right, step)) {
      const x = size.width / 2 + (value - view.x) * view.scale;
      halo(c, number(value, decimals), x, size.height - 8, colors.muted);
    }
    halo(c, `x [${unit}]`, size.width - 24, size.height - 8, colors.ink);
    c.textAlign = "left";
    for (const value of ticksBetween(bottom, top, step)) {
      const y = size.height / 2 - (value - view.y) * view.scale;
      halo(c, number(value, decimals), 8, y + 4, colors.muted);
    }
    halo(c, `${view.plane === 1 ? "y" : "z"} [${unit}]`, 8, 60, colors.ink);
  }

  function drawScaleBar(c) {
    const unit = artifact.unit === "unit" ? "units" : "m", step = niceStep(60);
    const narrow = size.width < 500, x = size.width - 16, y = size.height - (narrow ? 88 : 30);
    c.strokeStyle = colors.ink;
    c.lineWidth = 2;
    const length = step * view.scale;
    c.beginPath();
    c.moveTo(x - length, y - 5); c.lineTo(x - length, y); c.lineTo(x, y); c.lineTo(x, y - 5);
    c.stroke();
    c.font = "600 11px system-ui, sans-serif";
    c.textAlign = "center";
    const small = unit === "m" && step < 0.1;
    const text = small ? `${(1000 * step).toFixed(step < 0.001 ? 1 : 0)} mm` : `${step.toFixed(decimalsOf(step))} ${unit}`;
    halo(c, text, x - length / 2, y - 8, colors.ink);
    if (view.cursor) {
      const [a, b] = fromScreen(...view.cursor), decimals = decimalsOf(step) + 2;
      c.textAlign = "right";
      c.font = "11px ui-monospace, monospace";
      halo(c, `${a.toFixed(decimals)}, ${b.toFixed(decimals)}`, x, y - 26, colors.muted);
    }
  }

  function line(c, ax, ay, bx, by) {
    c.beginPath();
    c.moveTo(ax, ay);
    c.lineTo(bx, by);
    c.stroke();
  }

  function halo(c, text, x, y, color) {
    c.lineJoin = "round";
    c.lineWidth = 3;
    c.strokeStyle = colors.card;
    c.strokeText(text, x, y);
    c.fillStyle = color;
    c.fillText(text, x, y);
  }

  const FILLS = { paper: "paper-fill", pattern: "pattern-fill", north: "north", south: "south" };

  function drawGround(c) {
    c.save();
    const [x, y] = toScreen(0, 0, 0);
    c.translate(x, y);
    c.scale(view.scale, -view.scale);
    shapesOf().forEach((shape, index) => {
      if (shape.kind !== "polygon" && shape.kind !== "line") return;
      const path = pathOf(shape, index);
      if (FILLS[shape.style]) {
        c.fillStyle = colors[FILLS[shape.style]];
        c.fill(path);
      }
      if (shape.style === "north" || shape.style === "south") return;
      c.strokeStyle = colors[shape.style];
      c.lineWidth = (shape.style === "wall" ? 3 : 1) / view.scale;
      c.setLineDash(shape.style === "pattern" ? [3 / view.scale, 3 / view.scale] : []);
      c.stroke(path);
    });
    c.restore();
  }

  function drawMarks(c) {
    for (const shape of shapesOf()) {
      if (shape.kind === "station") {
        for (const [position, direction] of shape.points) drawStation(c, position, direction);
      } else if (shape.kind === "arrow" && view.plane === 1 && view.scale > 150) {
        c.strokeStyle = colors[shape.style];
        c.lineWidth = 1.5;
        c.beginPath();
        for (const [tail, tip] of shape.points) {
          c.moveTo(...toScreen(tail[0], tail[1], height(tail)));
          c.lineTo(...toScreen(tip[0], tip[1], height(tip)));
        }
        c.stroke();
      } else if (shape.kind === "marker") {
        drawMarkers(c, shape);
      }
    }
  }

  function drawMarkers(c, shape) {
    const isSquare = shape.style === "marker" || shape.style === "tag";
    if (shape.style === "tag" && view.scale > 150) return;
    const radius = isSquare ? 4 : Math.min(4, Math.max(0.8, 0.01 * view.scale));
    c.strokeStyle = colors[shape.style === "tag" ? "magnet" : shape.style];
    c.fillStyle = colors["magnet-fill"];
    c.lineWidth = radius > 2 ? 1.5 : 1;
    c.beginPath();
    for (const [point] of shape.points) {
      const [x, y] = toScreen(point[0], point[1], height(point));
      if (x < -PAD || y < -PAD || x > size.width + PAD || y > size.height + PAD) continue;
      if (isSquare) {
        c.rect(x - radius, y - radius, 2 * radius, 2 * radius);
      } else {
        c.moveTo(x + radius, y);
        c.arc(x, y, radius, 0, 7);
      }
    }
    c.fill();
    c.stroke();
  }

  function drawStation(c, position, direction) {
    const [x, y] = toScreen(...position);
    const dx = direction[0], dy = -(view.plane === 1 ? direction[1] : direction[2]);
    const length = Math.hypot(dx, dy), angle = Math.atan2(dy, dx);
    c.fillStyle = colors.station;
    c.save();
    c.translate(x, y);
    if (length > 0.1) {
      // The part of the room that it sees, about 115 degrees wide (shortened if it looks down).
      const radius = 20 + 50 * length;
      const gradient = c.createRadialGradient(0, 0, 6, 0, 0, radius);
      gradient.addColorStop(0, colors.station);
      gradient.addColorStop(1, "transparent");
      c.globalAlpha = 0.22;
      c.fillStyle = gradient;
      c.beginPath();
      c.moveTo(0, 0);
      c.arc(0, 0, radius, angle - 1, angle + 1);
      c.fill();
      c.globalAlpha = 1;
      c.strokeStyle = colors.station;
      c.lineWidth = 2;
      line(c, 0, 0, 24 * dx, 24 * dy);
    }
    c.rotate(angle);
    c.fillStyle = colors.station;
    c.fillRect(-6, -6, 12, 12);
    c.restore();
  }

  // Boxes of labels on a coarse raster, so that texts do not cover each other.
  function newOccupancy() {
    const cells = new Set();
    return (x, y, width, tall) => {
      const own = [];
      for (let i = Math.floor(x / 8); i <= (x + width) / 8; i++) {
        for (let j = Math.floor(y / 6); j <= (y + tall) / 6; j++) {
          const key = i * 100003 + j;
          if (cells.has(key)) return false;
          own.push(key);
        }
      }
      own.forEach((key) => cells.add(key));
      return true;
    };
  }

  function drawArtifactLabels(c) {
    const frame = artifact.frames[view.frame];
    if (!frame) return;
    c.font = "11px system-ui, sans-serif";
    c.textAlign = "center";
    c.textBaseline = "alphabetic";
    const isFree = newOccupancy();
    const visible = [];
    for (const label of frame.labels) {
      const [x, y] = toScreen(...label.at);
      const isVisible = x > -PAD && y > -PAD && x < size.width + PAD && y < size.height + PAD;
      if (isVisible) visible.push([label.text, x, y + 20]);
      if (visible.length > 500) return;
    }
    const free = visible.filter(([text, x, y]) => {
      const width = 6.2 * text.length;
      return isFree(x - width / 2, y - 10, width, 12);
    });
    // Some labels of a dense grid say less than none.
    if (visible.length > 20 && free.length < 0.7 * visible.length) return;
    for (const [text, x, y] of free) halo(c, text, x, y, colors.muted);
  }

  function draw(now) {
    const followed = devices.get(view.follow);
    if (followed && followed.pose && followed.pose.frame === view.frame) {
      view.x = followed.pose.x_m;
      view.y = view.plane === 1 ? followed.pose.y_m : followed.pose.z_m;
    } else if (view.auto) {
      fitIfNeeded();
    }
    const c = context;
    drawLayer(ground, [view.labels, version].join(" "), paintGround);
    const shown = [];
    for (const device of devices.values()) {
      if (device.pose && device.pose.frame === view.frame) shown.push(device);
    }
    if (view.trail_s) drawTrails(c, shown, now);
    for (const device of shown) drawEllipse(c, device, isOld(device, now));
    for (const device of shown) drawDevice(c, device, isOld(device, now));
    if (view.labels) drawNames(c, shown, now);
    drawTicks(c);
    drawScaleBar(c);
    if (connection === "lost") {
      c.fillStyle = colors["bad"];
      c.globalAlpha = 0.06;
      c.fillRect(0, 0, size.width, size.height);
      c.globalAlpha = 1;
    }
    $("empty").hidden = shown.length > 0 || connection === "lost";
    const hasPoses = [...devices.values()].some((device) => device.pose);
    set($("empty"), hasPoses ? "No device is in this frame" : "Waiting for the first pose");
    document.body.dataset.drawn = Number(document.body.dataset.drawn || 0) + 1;
  }

  // The strokes of all paths take longer than all else. They are painted each TRAIL_REFRESH_MS;
  // in between, only what is new is added.
  function drawTrails(c, shown, now) {
    const old = shown.map((device) => (isOld(device, now) ? device.index + "o" : device.index)).join(",");
    if (now - trails.painted > TRAIL_REFRESH_MS) trails.key = "";
    const isNew = drawLayer(trails, [old, view.trail_s, version].join(" "), (layer) => {
      layer.clearRect(-PAD, -PAD, size.width + 2 * PAD, size.height + 2 * PAD);
      trails.painted = now;
      for (const device of shown) drawTrail(layer, device, 0, now);
    });
    if (!isNew) {
      onLayer(trails, (layer) => {
        for (const device of shown) {
          const first = device.painted - (device.appended - device.trail.length);
          if (device.painted < device.appended) drawTrail(layer, device, Math.max(0, first - 1), now);
        }
      });
    }
    for (const device of shown) {
      // From the last point of the path to the newest pose.
      const last = device.trail[device.trail.length - 1], pose = device.pose;
      if (!last || last.reset !== pose.reset_counter || last.frame !== pose.frame) continue;
      c.strokeStyle = isOld(device, now) ? colors.muted : colorOf(device);
      c.lineWidth = 1.5;
      line(c, ...toScreen(last.x, last.y, last.z), ...toScreen(pose.x_m, pose.y_m, pose.z_m));
    }
  }

  function drawTrail(c, device, first, now) {
    const trail = device.trail, time = device.pose.time_s;
    device.painted = device.appended;
    c.strokeStyle = isOld(device, now) ? colors.muted : colorOf(device);
    c.lineWidth = 1.5;
    c.lineJoin = "bevel";
    let previous = null, x = 0, y = 0, part = "";
    c.beginPath();
    for (let k = first; k < trail.length; k++) {
      const point = trail[k], age = (time - point.t) / view.trail_s;
      if (age > 1) continue;
      const [px, py] = toScreen(point.x, point.y, point.z);
      // Older parts are paler; parts without a recent fix are dotted.
      const own = (age > 0.66 ? "a" : age > 0.33 ? "b" : "c") + (point.state === "tracking" ? "s" : "d");
      const joined = previous && previous.reset === point.reset && previous.frame === point.frame &&
        point.frame === view.frame;
      if (joined && own === part && k < trail.length - 1 && Math.abs(px - x) < 2 && Math.abs(py - y) < 2) {
        continue;
      }
      if (own !== part) {
        c.stroke();
        c.beginPath();
        part = own;
        c.globalAlpha = { a: 0.3, b: 0.55, c: 0.9 }[own[0]];
        c.setLineDash(own[1] === "s" ? [] : [2, 4]);
        if (joined) c.moveTo(x, y);
      }
      if (joined) c.lineTo(px, py);
      else c.moveTo(px, py);
      [x, y, previous] = [px, py, point];
    }
    c.stroke();
    c.globalAlpha = 1;
    c.setLineDash([]);
  }

  // Variances and covariance in the plane of the view, null if unknown.
  function covarianceOf(pose) {
    const isTop = view.plane === 1;
    const other = isTop ? pose.sigma_y_m : pose.sigma_z_m;
    const mixed = isTop ? pose.covariance_xy_m2 : pose.covariance_xz_m2;
    if (pose.sigma_x_m == null || other == null || mixed == null) return null;
    return [pose.sigma_x_m ** 2, other ** 2, mixed];
  }

  function principalAxes([xx, yy, xy]) {
    const mean = (xx + yy) / 2, radius = Math.hypot((xx - yy) / 2, xy);
    return [Math.sqrt(mean + radius), Math.sqrt(Math.max(0, mean - radius)), 0.5 * Math.atan2(2 * xy, xx - yy)];
  }

  function drawEllipse(c, device, old) {
    const covariance = covarianceOf(device.pose);
    if (!covariance || device.state === "lost") return;
    const [long, short, angle] = principalAxes(covariance);
    const [x, y] = toScreen(device.pose.x_m, device.pose.y_m, device.pose.z_m);
    const rx = ELLIPSE_95 * long * view.scale, ry = ELLIPSE_95 * short * view.scale;
    if (!(rx > 1 && rx < 1e5)) return;
    c.fillStyle = c.strokeStyle = old ? colors.muted : colorOf(device);
    c.lineWidth = 1;
    c.beginPath();
    c.ellipse(x, y, rx, ry, -angle, 0, 7);
    c.globalAlpha = 0.15;
    c.fill();
    c.globalAlpha = 0.8;
    c.stroke();
    c.globalAlpha = 1;
  }

  function headingVector(pose) {
    if (pose.qw == null) return null;
    const { qx: x, qy: y, qz: z, qw: w } = pose;
    return [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)];
  }

  function drawDevice(c, device, old) {
    const pose = device.pose, [x, y] = toScreen(pose.x_m, pose.y_m, pose.z_m);
    if (x < -40 || y < -40 || x > size.width + 40 || y > size.height + 40) return;
    const radius = device.name === view.follow ? 9 : 7;
    c.lineWidth = 2;
    if (device.state === "lost" || old) {
      c.strokeStyle = colors.muted;
      const r = radius - 1;
      line(c, x - r, y - r, x + r, y + r);
      line(c, x - r, y + r, x + r, y - r);
      return;
    }
    const color = colorOf(device), heading = headingVector(pose);
    c.strokeStyle = colors.card;
    c.fillStyle = color;
    if (heading) {
      const dx = heading[0], dy = -(view.plane === 1 ? heading[1] : heading[2]);
      const length = Math.hypot(dx, dy);
      if (length > 0.05) {
        const [ux, uy] = [dx / length, dy / length], tip = radius + 3 + 8 * length;
        c.beginPath();
        c.moveTo(x + ux * tip, y + uy * tip);
        c.lineTo(x + ux * 2 - uy * radius, y + uy * 2 + ux * radius);
        c.lineTo(x + ux * 2 + uy * radius, y + uy * 2 - ux * radius);
        c.closePath();
        c.stroke();
        c.fill();
      }
    }
    c.beginPath();
    c.arc(x, y, radius, 0, 7);
    c.stroke();
    if (device.state === "tracking") {
      c.fill();
      return;
    }
    c.fillStyle = colors.card;
    c.fill();
    c.fillStyle = c.strokeStyle = color;
    c.lineWidth = 2.5;
    c.stroke();
    if (device.state === "dead reckoning") {
      c.beginPath();
      c.arc(x, y, radius, Math.PI / 2, 1.5 * Math.PI);
      c.fill();
    } else {
      c.font = "700 10px system-ui, sans-serif";
      c.textAlign = "center";
      c.textBaseline = "middle";
      c.fillStyle = colors.ink;
      c.fillText("?", x, y + 0.5);
    }
  }

  function drawNames(c, shown, now) {
    const isFree = newOccupancy();
    c.textAlign = "left";
    c.textBaseline = "middle";
    const order = [...shown].sort((a, b) => (b.name === view.follow) - (a.name === view.follow));
    for (const device of order) {
      const pose = device.pose, [x, y] = toScreen(pose.x_m, pose.y_m, pose.z_m);
      if (x < -60 || y < -20 || x > size.width || y > size.height + 20) continue;
      const old = isOld(device, now);
      const state = device.state === "lost" ? "lost"
        : old ? age((now - device.received) / 1000) + " old"
        : device.state === "tracking" ? "" : device.state;
      const name = device.name.length > 24 ? device.name.slice(0, 23) + "…" : device.name;
      const text = state ? `${name} · ${state}` : name;
      // Above to the right, else below.
      const dy = [-9, 12].find((each) => isFree(x + 14, y + each - 6, 6.8 * text.length, 12));
      if (dy === undefined) continue;
      c.font = "600 12px system-ui, sans-serif";
      halo(c, text, x + 14, y + dy, old || device.state === "lost" ? colors.muted : colors.ink);
    }
  }

  // ---- table

  function element(name, className, text) {
    const made = document.createElement(name);
    if (className) made.className = className;
    if (text !== undefined) made.textContent = text;
    return made;
  }

  function newRow(device) {
    const row = element("tr"), cells = {};
    const first = element("td");
    const button = element("button", "name");
    button.type = "button";
    button.title = "Follow on the map: " + device.name;
    button.setAttribute("aria-pressed", "false");
    const dot = element("i");
    dot.style.background = `var(--d${device.index % COLOR_COUNT})`;
    button.append(dot, element("span", "", device.name));
    button.onclick = () => follow(view.follow === device.name ? "" : device.name);
    first.append(button);
    row.append(first);
    const status = element("td", "status");
    cells.chip = element("span", "chip", "no pose yet");
    cells.reason = element("span", "reason");
    status.append(cells.chip, " ", cells.reason);
    row.append(status);
    for (const [key, label, extra] of [
      ["x", "x [m]", "value"], ["y", "y [m]", "value"], ["z", "z [m]", "value"], ["heading", "Heading", "value"],
      ["sigma", "Sigma", "value"], ["rate", "Rate", ""], ["latency", "Latency", ""], ["age", "Age", "age"],
    ]) {
      cells[key] = element("td", "number " + extra, "–");
      cells[key].dataset.label = label;
      row.append(cells[key]);
    }
    cells.detection = element("td", "detection");
    row.append(cells.detection);
    cells.button = button;
    device.cells = cells;
    return row;
  }

  function set(node, text) {
    if (node.textContent !== text) node.textContent = text;
  }

  function updateTable(now) {
    let tracking = 0;
    for (const device of devices.values()) {
      const cells = device.cells, pose = device.pose, old = pose !== null && isOld(device, now);
      const isLost = device.state === "lost";
      if (device.state === "tracking" && !old) tracking++;
      const state = old && !isLost ? "old: " + device.state : device.state || "no pose yet";
      set(cells.chip, state);
      const chip = "chip " + (old ? "bad" : CHIPS[device.state] || "");
      if (cells.chip.className !== chip) cells.chip.className = chip;
      set(cells.reason, device.reason || "");
      device.row.classList.toggle("old", old || isLost);
      if (pose) {
        set(cells.x, number(pose.x_m, 3));
        set(cells.y, number(pose.y_m, 3));
        set(cells.z, number(pose.z_m, 3));
        const heading = headingVector(pose);
        set(cells.heading, heading ? degrees(Math.atan2(heading[1], heading[0])) : "–");
        const top = pose.sigma_x_m == null || pose.sigma_y_m == null ? null
          : principalAxes([pose.sigma_x_m ** 2, pose.sigma_y_m ** 2, pose.covariance_xy_m2 || 0])[0];
        set(cells.sigma, top == null ? "–" : distance(top));
        set(cells.age, age((now - device.received) / 1000));
      }
      set(cells.rate, device.rate == null ? "–" : device.rate.toFixed(device.rate < 10 ? 1 : 0) + " Hz");
      set(cells.latency, device.latency == null ? "–" : milliseconds(device.latency));
      set(cells.detection, device.detection);
      cells.detection.title = device.detection;
      cells.reason.title = device.reason || "";
    }
    const others = devices.size - tracking;
    set($("summary"), devices.size ? `${tracking} of ${devices.size} ${devices.size === 1 ? "device" : "devices"} tracking` +
      (others ? `, ${others} not` : "") : "");
  }

  const number = (value, decimals) => (value == null ? "–" : value.toFixed(decimals).replace("-", "−"));
  const degrees = (radians) => number((radians * 180) / Math.PI, 0) + "°";
  const milliseconds = (value) => (1000 * value).toFixed(value < 0.00995 ? 1 : 0) + " ms";

  function distance(value) {
    if (value >= 1) return value.toFixed(2) + " m";
    if (value >= 0.1) return (100 * value).toFixed(0) + " cm";
    if (value < 0.0001) return (1e6 * value).toFixed(0) + " µm";
    return (1000 * value).toFixed(value < 0.00995 ? 1 : 0) + " mm";
  }

  function age(seconds) {
    if (!Number.isFinite(seconds)) return "–";
    if (seconds < 60) return seconds.toFixed(seconds < 10 ? 1 : 0) + " s";
    return seconds < 3600 ? Math.floor(seconds / 60) + " min" : Math.floor(seconds / 3600) + " h";
  }

  const clock = (date) => date.toTimeString().slice(0, 8);

  // ---- events

  function describeDetection(d) {
    const parts = [];
    if (d.tag_id != null) parts.push("tag " + d.tag_id);
    else if ("tag_id" in d) parts.push("tag not read");
    if (d.channel != null) parts.push("station " + d.channel + (d.id ? ` (${d.id})` : ""));
    if (d.sheet != null) parts.push("sheet " + d.sheet);
    if (Array.isArray(d.cell)) parts.push("landmark " + d.cell.join(","));
    else if ("cell" in d && d.code != null) parts.push("landmark of unknown cell");
    else if ("cell" in d) parts.push("landmark not read");
    if (d.turn_rad != null) {
      parts.push(`heading corrected by ${(d.turn_rad * 180 / Math.PI).toFixed(1)}°, tag ${d.from} to ${d.to}`);
    }
    if (d.refused) parts.push("refused: " + String(d.refused).replaceAll("_", " "));
    return parts.join(", ") || "detection";
  }

  function describe(message) {
    if (message.type === "state") {
      return message.state + (message.reason ? ": " + message.reason : "");
    }
    if (message.type === "correction") {
      const moved = Math.hypot(...message.displacement_m.map((value) => value || 0));
      const turned = message.rotation_rad == null ? "" : ", " + number(message.rotation_rad * 180 / Math.PI, 1) + "°";
      return `corrected by ${distance(moved)}${turned} (${message.reason})`;
    }
    if (message.type === "artifact") {
      return `version ${message.version}` + (message.reason ? ": " + message.reason : "");
    }
    return message.type === "warning" ? message.message : describeDetection(message.detection);
  }

  let pending = [];

  function addEvent(message) {
    pending.push(message);
    if (pending.length > 2 * MAX_EVENTS) {
      const detections = pending.filter((each) => each.type === "detection").slice(-20);
      const others = pending.filter((each) => each.type !== "detection").slice(-MAX_EVENTS);
      pending = [...others, ...detections].sort((a, b) => a.time_s - b.time_s);
    }
  }

  function updateEvents() {
    const list = $("events");
    for (const message of pending) {
      const text = describe(message);
      const subject = message.type === "artifact" ? "map" : message.device || "session";
      const first = list.firstElementChild;
      // Equal detections in sequence, as of each frame, are one line.
      const key = JSON.stringify([message.type, subject, text]);
      if (message.type === "detection" && first && first.dataset.key === key) {
        const count = Number(first.dataset.count || 1) + 1;
        first.dataset.count = count;
        first.querySelector("small").textContent = ` ×${count}`;
        first.querySelector("time").textContent = clock(new Date(1000 * message.time_s));
        continue;
      }
      const lost = message.type === "state" && message.state === "lost" ? " lost" : "";
      const item = element("li", message.type + lost);
      item.dataset.key = key;
      const body = element("span");
      body.append(element("b", "", subject), " ", text, element("small"));
      item.append(element("time", "", clock(new Date(1000 * message.time_s))), body);
      list.prepend(item);
    }
    pending = [];
    while (list.children.length > MAX_EVENTS) list.lastElementChild.remove();
  }

  // ---- health

  function setHealth(message) {
    for (const [name, rate] of Object.entries(message.rates_hz)) deviceOf(name).rate = rate;
    const status = message.status;
    const chip = $("health");
    chip.hidden = Object.keys(status).length === 0;
    chip.textContent = status.ok ? "healthy" : "degraded";
    chip.className = "chip " + (status.ok ? "good" : "bad");
    const nodes = [];
    addFacts(status, "", nodes);
    if (!nodes.length) nodes.push(element("dt", "", "no report"), element("dd"));
    $("facts").replaceChildren(...nodes.slice(0, 200));
  }

  // Add the facts of an object, then those of its parts under headings.
  function addFacts(facts, heading, nodes) {
    const parts = [];
    const own = [];
    for (const [key, value] of Object.entries(facts)) {
      const isList = Array.isArray(value) && !value.some((each) => each !== null && typeof each === "object");
      if (value !== null && typeof value === "object" && !isList) {
        parts.push([key, value]);
        continue;
      }
      if ((key === "ok" && value === true) || (/error/.test(key) && !value) || value === null) continue;
      const isBad = key === "ok" || /error/.test(key) || (/dropped|lost/.test(key) && value > 0);
      own.push(element("dt", "", key.replace(/_(s|m|hz|rad)$/, " [$1]").replaceAll("_", " ")));
      own.push(element("dd", isBad ? "bad" : "", factText(value)));
    }
    if (heading && own.length) nodes.push(element("dt", "group", heading));
    nodes.push(...own);
    for (const [key, value] of parts) {
      if (Array.isArray(value)) {
        value.forEach((each, k) => {
          const { address, name, ...rest } = each || {};
          addFacts(rest, String(address || name || `${key} ${k + 1}`), nodes);
        });
      } else {
        addFacts(value, key.replaceAll("_", " "), nodes);
      }
    }
  }

  function factText(value) {
    if (value === true) return "yes";
    if (value === false) return "no";
    if (value == null) return "–";
    if (Array.isArray(value)) return value.join(", ");
    if (typeof value === "number" && !Number.isInteger(value)) return String(Number(value.toPrecision(3)));
    if (typeof value === "number") return value.toLocaleString("en").replaceAll(",", "\u202f");
    return String(value);
  }

  // ---- input

  const pointers = new Map();

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.offsetX, y: event.offsetY, moved: 0 });
    canvas.classList.add("dragging");
  });
  canvas.addEventListener("pointermove", (event) => {
    view.cursor = event.pointerType === "touch" ? null : [event.offsetX, event.offsetY];
    dirty = true;
    const pointer = pointers.get(event.pointerId);
    if (!pointer) return;
    const dx = event.offsetX - pointer.x, dy = event.offsetY - pointer.y;
    const other = [...pointers.entries()].find(([id]) => id !== event.pointerId);
    pointer.moved += Math.hypot(dx, dy);
    if (other) {
      const before = Math.hypot(pointer.x - other[1].x, pointer.y - other[1].y);
      const after = Math.hypot(event.offsetX - other[1].x, event.offsetY - other[1].y);
      if (before > 10 && after > 10) zoom(after / before, other[1].x, other[1].y);
    } else if (pointer.moved > 4) {
      pan(dx, dy);
    }
    pointer.x = event.offsetX;
    pointer.y = event.offsetY;
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => {
      const pointer = pointers.get(event.pointerId);
      pointers.delete(event.pointerId);
      canvas.classList.remove("dragging");
      if (name === "pointerup" && pointer && pointer.moved <= 4) pick(event.offsetX, event.offsetY);
    });
  }
  canvas.addEventListener("pointerleave", () => { view.cursor = null; dirty = true; });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-0.0015 * Math.max(-300, Math.min(300, event.deltaY))), event.offsetX, event.offsetY);
  }, { passive: false });
  canvas.addEventListener("dblclick", showAll);
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const steps = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
    if (steps[event.key]) pan(...steps[event.key]);
    else if (event.key === "+" || event.key === "=") zoom(1.25);
    else if (event.key === "-") zoom(0.8);
    else if (event.key === "f" || event.key === "F") showAll();
    else if (event.key === "Escape") follow("");
    else return;
    event.preventDefault();
  });

  // Follow the device at a position of the screen, if there is one.
  function pick(x, y) {
    let best = null, least = 18;
    for (const device of devices.values()) {
      if (!device.pose || device.pose.frame !== view.frame) continue;
      const [px, py] = toScreen(device.pose.x_m, device.pose.y_m, device.pose.z_m);
      const away = Math.hypot(px - x, py - y);
      if (away < least) [best, least] = [device, away];
    }
    if (best) follow(best.name);
  }

  function showAll() {
    follow("");
    view.auto = true;
    fit();
    dirty = true;
  }

  function toggle(button, change) {
    button.onclick = () => {
      const pressed = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", String(pressed));
      change(pressed);
      dirty = true;
    };
  }

  $("zoom-in").onclick = () => zoom(1.4);
  $("zoom-out").onclick = () => zoom(1 / 1.4);
  $("fit").onclick = showAll;
  toggle($("plane"), (pressed) => { view.plane = pressed ? 2 : 1; view.auto = true; fit(); });
  toggle($("labels"), (pressed) => { view.labels = pressed; });
  $("frame").onchange = (event) => {
    follow("");
    view.isFrameChosen = true;
    setFrame(event.target.value);
  };
  $("follow").onchange = (event) => follow(event.target.value);
  $("trail").onchange = (event) => { view.trail_s = Number(event.target.value); dirty = true; };
  $("detections").onchange = (event) => $("events").classList.toggle("no-detections", !event.target.checked);

  // ---- start

  function loop(now) {
    requestAnimationFrame(loop);
    if (now >= tableDue) {
      tableDue = now + TABLE_INTERVAL_MS;
      updateTable(performance.now());
      updateEvents();
      dirty = true;  // Poses get old without any message.
    }
    if (!dirty) return;
    dirty = false;
    draw(performance.now());
  }

  readColors();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", readColors);
  new ResizeObserver(resize).observe(canvas);
  resize();
  requestAnimationFrame(loop);
  if (document.documentElement.dataset.token === "required" && !token) {
    setConnection("lost");
    $("connection").textContent = "no access";
    $("banner").textContent = "This page needs a token. Open the complete address that locatk live printed, " +
      "with the part behind #.";
  } else {
    connect();
  }
})();
