
"use strict";
(() => {
  // Everything written comes from `data` and goes in as text, never as markup.
  const data = JSON.parse(document.getElementById("data").textContent);
  const { goals, pairs, episodes, seen } = data;
  const ARROWS_FROM = 12; // Cells of this edge have room for arrows [px].
  const EPISODES_AT_FIRST = 24;
  const NS = "http://www.w3.org/2000/svg";
  const byId = (id) => document.getElementById(id);
  const state = { least: 0.5, rank: null, pinned: null, at: null };

  const number = (value, digits = 2) => value.toLocaleString("en", {
    minimumFractionDigits: digits, maximumFractionDigits: digits,
  });
  const count = (value, one, many = one + "s") => `${number(value, 0)} ${value === 1 ? one : many}`;
  const size = (value) => Math.abs(value) >= 1e5 || (value !== 0 && Math.abs(value) < 1e-3)
    ? value.toExponential(1) : String(Number(value.toPrecision(4)));
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  // The probability is rounded for the eye; the comparison allows for that.
  const shown = (goal) => goal.probability >= state.least - 1e-9;
  const rankShown = (rank) => rank === 0 || shown(goals[rank - 1]);

  function make(tag, properties = {}, ...children) {
    const element = document.createElement(tag);
    Object.assign(element, properties);
    element.append(...children);
    return element;
  }

  function svg(tag, attributes = {}, text = "") {
    const element = document.createElementNS(NS, tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    if (text) element.textContent = text;
    return element;
  }

  function sharp(canvas) {
    const ratio = Math.max(window.devicePixelRatio || 1, 2);
    const { clientWidth: width, clientHeight: height } = canvas;
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    return { pen, width, height };
  }

  // ---- What is told of a thing ----

  const placeOf = (goal) => `(${number(goal.place[0])}, ${number(goal.place[1])}) m`;

  function goalLines(goal) {
    const lines = [goal.rank ? `Subgoal ${goal.rank}: ${goal.label}` : `Candidate ${goal.label}`];
    lines.push(`probability ${number(goal.probability)}`);
    if (goal.rank) lines.push(count(goal.observations, "observation"));
    else if (goal.counts_as) lines.push(`counts as subgoal ${goal.counts_as}`);
    else lines.push("not in the posterior mode");
    if (goal.pursuits !== null) lines.push(`${number(goal.pursuits, 1)} expected pursuits`);
    if (goal.visits.length) {
      const some = goal.visits.slice(0, 6).join(", ") + (goal.visits.length > 6 ? ", \u2026" : "");
      lines.push(`${goal.visits.length > 1 ? "visits" : "visit"} ${some} of the first episode that goes there`);
    }
    lines.push(`at ${placeOf(goal)} in ${data.frame}`);
    return lines;
  }

  const purpose = (rank) => rank === 0 ? "no subgoal explains it"
    : `for subgoal ${rank}, ${goals[rank - 1].label}`;

  function row(rank, text) {
    const dot = make("span", { className: "dot" });
    dot.style.background = data.colours[rank];
    return make("span", { className: "row" }, dot, make("span", { textContent: text }));
  }

  function pairRows(list) {
    const rows = list.slice(0, 8).map((i) => row(pairs.rank[i],
      `${data.actions[pairs.action[i]]}, ${pairs.count[i].toLocaleString("en")}\u00d7, `
      + `${purpose(pairs.rank[i])}, probability ${number(pairs.sure[i])}`));
    if (list.length > 8) rows.push(make("span", { className: "quiet", textContent: `and ${list.length - 8} more` }));
    return rows;
  }

  const tip = byId("tip");

  function tell(nodes, x, y) {
    tip.replaceChildren(...nodes);
    tip.hidden = false;
    const { width, height } = tip.getBoundingClientRect();
    const left = x + 16 + width > innerWidth - 8 ? x - 16 - width : x + 16;
    const top = Math.min(Math.max(y - height / 2, 8), innerHeight - height - 8);
    tip.style.transform = `translate(${Math.max(left, 8)}px, ${Math.max(top, 8)}px)`;
  }

  const hush = () => { tip.hidden = true; };

  function goalNodes(goal) {
    const [head, ...rest] = goalLines(goal);
    return [make("b", { textContent: head }), ...rest.map((text) => make("div", { textContent: text }))];
  }

  // ---- The map ----

  const stage = byId("stage");
  const map = byId("map");
  const markers = byId("markers");
  const view = { x: 0, y: 0, scale: 1 }; // The cell in the middle, and a cell's edge [px].
  const ground = new Image();
  let blocked = null; // The map's blocked cells in the colour of the theme.
  let areas = null; // Of feature subgoals: which goal, if any, each cell belongs to.
  let tint = null;

  const pairsAt = new Map();
  pairs.x.forEach((x, i) => {
    const key = pairs.y[i] * data.width + x;
    if (!pairsAt.has(key)) pairsAt.set(key, []);
    pairsAt.get(key).push(i);
  });
  for (const list of pairsAt.values()) list.sort((a, b) => pairs.count[b] - pairs.count[a]);
  const goalsAt = new Map();
  goals.forEach((goal) => {
    const key = goal.cell[1] * data.width + goal.cell[0];
    if (!goalsAt.has(key)) goalsAt.set(key, []);
    goalsAt.get(key).push(goal);
  });
  const mostOften = Math.max(1, ...new Set(pairs.count));
  const seenLast = pairs.x.map((_, i) => i).sort((a, b) => pairs.turn[a] - pairs.turn[b]
    || (pairs.rank[a] > 0) - (pairs.rank[b] > 0) || pairs.count[a] - pairs.count[b]);

  const across = (x) => map.clientWidth / 2 + (x - view.x) * view.scale;
  const down = (y) => map.clientHeight / 2 - (y - view.y) * view.scale;

  function fit(low, high) {
    const [width, height] = [high[0] - low[0] + 1, high[1] - low[1] + 1];
    const edge = Math.min((stage.clientWidth - 24) / width, (stage.clientHeight - 24) / height);
    Object.assign(view, { x: (low[0] + high[0]) / 2, y: (low[1] + high[1]) / 2, scale: Math.min(edge, 90) });
  }

  function fitAll() {
    fit([0, 0], [data.width - 1, data.height - 1]);
  }

  // What was walked, where the map is much larger than that.
  function fitSeen() {
    if (!pairs.x.length) return fitAll();
    const margin = 4;
    const low = [data.width, data.height];
    const high = [0, 0];
    for (const [x, y] of [...pairs.x.map((x, i) => [x, pairs.y[i]]), ...goals.filter((g) => g.rank).map((g) => g.cell)]) {
      low[0] = Math.min(low[0], x); low[1] = Math.min(low[1], y);
      high[0] = Math.max(high[0], x); high[1] = Math.max(high[1], y);
    }
    const area = (high[0] - low[0] + 2 * margin) * (high[1] - low[1] + 2 * margin);
    if (area > 0.5 * data.width * data.height) return fitAll();
    return fit([low[0] - margin, low[1] - margin], [high[0] + margin, high[1] + margin]);
  }

  function zoom(factor, x = map.clientWidth / 2, y = map.clientHeight / 2) {
    const smallest = 0.5 * Math.min(stage.clientWidth / data.width, stage.clientHeight / data.height);
    const scale = Math.min(Math.max(view.scale * factor, Math.min(smallest, view.scale)), 160);
    view.x += (x - map.clientWidth / 2) * (1 / view.scale - 1 / scale);
    view.y -= (y - map.clientHeight / 2) * (1 / view.scale - 1 / scale);
    view.scale = scale;
    draw();
  }

  function move(right, up) {
    view.x = Math.min(Math.max(view.x + right / view.scale, 0), data.width - 1);
    view.y = Math.min(Math.max(view.y + up / view.scale, 0), data.height - 1);
    draw();
  }

  function painted(image, fill) {
    const canvas = make("canvas", { width: data.width, height: data.height });
    const pen = canvas.getContext("2d");
    pen.drawImage(image, 0, 0);
    pen.globalCompositeOperation = "source-in";
    pen.fillStyle = fill;
    pen.fillRect(0, 0, data.width, data.height);
    return canvas;
  }

  function paintTint() {
    if (!areas) return;
    const canvas = make("canvas", { width: data.width, height: data.height });
    const pen = canvas.getContext("2d");
    const image = pen.createImageData(data.width, data.height);
    const colours = goals.map((goal) => {
      if (!shown(goal)) return null;
      const code = parseInt(data.colours[goal.rank].slice(1), 16);
      const other = state.rank !== null && state.rank !== goal.rank;
      const strength = other ? 18 : goal.rank ? 70 : 46;
      return [code >> 16, (code >> 8) & 255, code & 255, strength];
    });
    areas.forEach((goal, i) => {
      if (goal && colours[goal - 1]) image.data.set(colours[goal - 1], 4 * i);
    });
    pen.putImageData(image, 0, 0);
    tint = canvas;
  }

  function drawArrow(pen, i, scale) {
    const [dx, dy] = data.steps[pairs.action[i]];
    const often = Math.sqrt(pairs.count[i] / mostOften) * 0.6 ** pairs.turn[i];
    const [x, y] = [across(pairs.x[i]), down(pairs.y[i])];
    pen.beginPath();
    if (dx === 0 && dy === 0) {
      pen.arc(x, y, (0.07 + 0.13 * often) * scale, 0, 2 * Math.PI);
    } else {
      const length = Math.hypot(dx, dy);
      const [ax, ay] = [dx / length, dy / length];
      const long = 0.46 * Math.sqrt(length) * scale;
      const wide = (0.04 + 0.16 * often) * scale;
      for (const [along, aside] of data.arrow) {
        pen.lineTo(x + along * long * ax - aside * wide * ay, y - along * long * ay - aside * wide * ax);
      }
      pen.closePath();
    }
    pen.fill();
    pen.stroke();
  }

  function drawObservations(pen, width, height) {
    const arrows = view.scale >= ARROWS_FROM;
    const faded = colour("--faded");
    const unexplained = colour("--muted");
    const dot = Math.max(3.2, 0.8 * view.scale);
    pen.lineWidth = 0.6;
    pen.strokeStyle = colour("--paper");
    for (const below of [true, false]) {
      for (const i of seenLast) {
        const rank = pairs.rank[i];
        const hidden = !rankShown(rank);
        if (hidden !== below) continue;
        const [x, y] = [across(pairs.x[i]), down(pairs.y[i])];
        if (x < -view.scale || y < -view.scale || x > width + view.scale || y > height + view.scale) continue;
        pen.fillStyle = hidden ? faded : rank ? data.colours[rank] : unexplained;
        pen.globalAlpha = state.rank !== null && state.rank !== rank ? 0.13 : 1;
        if (arrows) drawArrow(pen, i, view.scale);
        else pen.fillRect(x - dot / 2, y - dot / 2, dot, dot);
      }
    }
    pen.globalAlpha = 1;
  }

  function badge(pen, text, x, y, ink, paper) {
    pen.font = "600 10px system-ui, sans-serif";
    const width = Math.max(15, pen.measureText(text).width + 8);
    pen.beginPath();
    pen.roundRect(x - width / 2, y - 7.5, width, 15, 7.5);
    pen.fillStyle = paper;
    pen.fill();
    pen.lineWidth = 1;
    pen.strokeStyle = ink;
    pen.stroke();
    pen.fillStyle = ink;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.fillText(text, x, y + 0.5);
  }

  function drawWays(pen) {
    const ink = colour("--sign");
    const paper = colour("--paper");
    const ways = data.ways.filter((way) => rankShown(way.here) && rankShown(way.there));
    const most = Math.max(1, ...data.ways.map((way) => way.times));
    const pairsOfRanks = new Set(ways.map((way) => `${way.here} ${way.there}`));
    const badges = [];
    const taken = goals.filter((goal) => goal.rank && shown(goal)).map((goal) => [across(goal.cell[0]), down(goal.cell[1])]);
    // How much of a badge lies on others and on the markers, at a place of its way.
    const covered = ([x, y]) => taken.reduce((sum, [ox, oy]) => sum
      + Math.max(0, 28 - Math.abs(x - ox)) * Math.max(0, 18 - Math.abs(y - oy)), 0);
    for (const way of ways) {
      const [from, to] = [way.here, way.there].map((rank) => goals[rank - 1].cell);
      const [x0, y0, x1, y1] = [across(from[0]), down(from[1]), across(to[0]), down(to[1])];
      const [dx, dy] = [x1 - x0, y1 - y0];
      const length = Math.hypot(dx, dy);
      if (length < 34) continue;
      const bend = pairsOfRanks.has(`${way.there} ${way.here}`) ? 0.16 : 0.1;
      const [cx, cy] = [(x0 + x1) / 2 - bend * dy, (y0 + y1) / 2 + bend * dx];
      const at = (t) => [(1 - t) ** 2 * x0 + 2 * t * (1 - t) * cx + t * t * x1,
        (1 - t) ** 2 * y0 + 2 * t * (1 - t) * cy + t * t * y1];
      const [t0, t1] = [14 / length, 1 - 16 / length];
      const points = Array.from({ length: 25 }, (_, k) => at(t0 + (t1 - t0) * k / 24));
      const wide = Math.max(1.2, Math.min(1.6 * Math.sqrt(most), 4.5) * way.times / most);
      const loud = state.rank === null || state.rank === way.here || state.rank === way.there;
      const alpha = loud ? Math.max(0.45, Math.min(1, 9 / (ways.length + 1))) : 0.1;
      const [tx, ty] = points[24];
      const [bx, by] = points[22];
      const angle = Math.atan2(ty - by, tx - bx);
      const head = 6 + 1.4 * wide;
      const line = points.filter(([x, y]) => Math.hypot(x - tx, y - ty) > head);
      line.push([tx - 0.8 * head * Math.cos(angle), ty - 0.8 * head * Math.sin(angle)]);
      for (const [width, style, part] of [[wide + 2.6, paper, 0.7 * alpha], [wide, ink, alpha]]) {
        pen.globalAlpha = part;
        pen.strokeStyle = style;
        pen.lineWidth = width;
        pen.setLineDash(style === ink ? [6, 3.5] : []);
        pen.beginPath();
        line.forEach(([x, y]) => pen.lineTo(x, y));
        pen.stroke();
      }
      pen.setLineDash([]);
      pen.fillStyle = ink;
      pen.beginPath();
      pen.moveTo(tx + 2 * Math.cos(angle), ty + 2 * Math.sin(angle));
      for (const side of [2.65, -2.65]) pen.lineTo(tx + head * Math.cos(angle + side), ty + head * Math.sin(angle + side));
      pen.fill();
      if (way.numbers.length && loud) {
        const text = way.numbers.slice(0, 3).join(", ") + (way.numbers.length > 3 ? ", \u2026" : "");
        const places = [0.5, 0.6, 0.4, 0.7, 0.3].map(at);
        const best = places.reduce((a, b) => (covered(b) < covered(a) ? b : a));
        badges.push([text, ...best]);
        taken.push(best);
      }
    }
    pen.globalAlpha = 1;
    for (const [text, x, y] of badges) badge(pen, text, x, y, ink, paper);
  }

  function drawOthers(pen) {
    pen.setLineDash([3, 2]);
    pen.lineWidth = 1.6;
    for (const goal of goals) {
      if (goal.rank || !shown(goal)) continue;
      pen.globalAlpha = state.rank === null || state.rank === goal.counts_as ? 0.35 + 0.65 * goal.probability : 0.15;
      pen.strokeStyle = goal.counts_as ? data.colours[goal.counts_as] : "#1c2129";
      pen.beginPath();
      pen.arc(across(goal.cell[0]), down(goal.cell[1]), 4 + 5 * Math.sqrt(goal.probability), 0, 2 * Math.PI);
      pen.stroke();
    }
    pen.setLineDash([]);
    pen.globalAlpha = 1;
  }

  function drawScale(pen, width, height) {
    const metre = view.scale / data.resolution;
    const power = 10 ** Math.floor(Math.log10(110 / metre));
    const length = [5, 2, 1].map((k) => k * power).find((k) => k * metre <= 110);
    const [x, y, wide] = [14, height - 14, length * metre];
    pen.font = "600 11px system-ui, sans-serif";
    pen.textAlign = "left";
    pen.textBaseline = "bottom";
    const text = length >= 1 ? `${length} m` : `${Number((100 * length).toPrecision(1))} cm`;
    pen.fillStyle = "#ffffffd9";
    pen.beginPath();
    pen.roundRect(x - 7, y - 20, Math.max(wide, pen.measureText(text).width) + 14, 27, 6);
    pen.fill();
    pen.strokeStyle = pen.fillStyle = "#1c2129";
    pen.lineWidth = 1.5;
    pen.beginPath();
    for (const [px, py] of [[x, y - 4], [x, y], [x + wide, y], [x + wide, y - 4]]) pen.lineTo(px, py);
    pen.stroke();
    pen.fillText(text, x, y - 4);
  }

  function drawCursor(pen) {
    if (state.at === null) return;
    const i = seen[state.at];
    const radius = Math.max(0.48 * view.scale, 7);
    for (const [style, width] of [["#ffffff", 5], ["#1c2129", 2.4]]) {
      pen.strokeStyle = style;
      pen.lineWidth = width;
      pen.beginPath();
      pen.arc(across(pairs.x[i]), down(pairs.y[i]), radius, 0, 2 * Math.PI);
      pen.stroke();
    }
  }

  function draw() {
    const { pen, width, height } = sharp(map);
    const [left, right] = [across(-0.5), across(data.width - 0.5)];
    const [bottom, top] = [down(-0.5), down(data.height - 0.5)];
    pen.fillStyle = colour("--paper");
    pen.fillRect(left, top, right - left, bottom - top);
    if (view.scale >= ARROWS_FROM) {
      pen.strokeStyle = colour("--grid");
      pen.lineWidth = 1;
      pen.beginPath();
      for (let x = Math.max(0, Math.floor(view.x - width)); x < data.width - 1; x += 1) {
        const at = across(x + 0.5);
        if (at > width) break;
        if (at >= 0) { pen.moveTo(at, top); pen.lineTo(at, bottom); }
      }
      for (let y = Math.max(0, Math.floor(view.y - height)); y < data.height - 1; y += 1) {
        const at = down(y + 0.5);
        if (at < 0) break;
        if (at <= height) { pen.moveTo(left, at); pen.lineTo(right, at); }
      }
      pen.stroke();
    }
    pen.imageSmoothingEnabled = view.scale < 2;
    if (blocked) pen.drawImage(blocked, left, top, right - left, bottom - top);
    pen.imageSmoothingEnabled = false;
    if (tint) pen.drawImage(tint, left, top, right - left, bottom - top);
    if (byId("show-observations").checked) drawObservations(pen, width, height);
    if (byId("show-ways").checked) drawWays(pen);
    drawOthers(pen);
    drawCursor(pen);
    drawScale(pen, width, height);
    placeMarkers();
  }

  function placeMarkers() {
    const places = goals.filter((goal) => goal.rank).map((goal) => [goal, across(goal.cell[0]), down(goal.cell[1])]);
    const visible = places.filter(([goal]) => shown(goal));
    for (const [goal, x, y] of places) {
      const { marker } = goal;
      marker.hidden = !shown(goal) || x < -13 || y < -13 || x > map.clientWidth + 13 || y > map.clientHeight + 13;
      marker.style.transform = `translate(${x}px, ${y}px)`;
      marker.classList.toggle("dim", state.rank !== null && state.rank !== goal.rank);
      marker.classList.toggle("chosen", state.rank === goal.rank);
      const crowded = visible.some(([other, ox, oy]) => other !== goal && Math.abs(ox - x) < 32 && oy - y > -8 && oy - y < 40);
      marker.lastChild.hidden = crowded;
    }
  }

  function cellAt(event) {
    const box = map.getBoundingClientRect();
    const x = view.x + (event.clientX - box.left - map.clientWidth / 2) / view.scale;
    const y = view.y - (event.clientY - box.top - map.clientHeight / 2) / view.scale;
    const [cx, cy] = [Math.round(x), Math.round(y)];
    const reach = view.scale >= ARROWS_FROM ? 0 : Math.ceil(7 / view.scale);
    let best = null;
    for (let ny = cy - reach; ny <= cy + reach; ny += 1) {
      for (let nx = cx - reach; nx <= cx + reach; nx += 1) {
        if (nx < 0 || ny < 0 || nx >= data.width || ny >= data.height) continue;
        const key = ny * data.width + nx;
        const there = (goalsAt.get(key) || []).some(shown) || pairsAt.has(key);
        const apart = Math.hypot(nx - x, ny - y) - (there ? 1000 : 0);
        if (best === null || apart < best.apart) best = { x: nx, y: ny, key, apart, there };
      }
    }
    return best;
  }

  function tellCell(event) {
    const cell = cellAt(event);
    if (!cell) return hush();
    const found = (goalsAt.get(cell.key) || []).filter(shown);
    const area = areas && areas[(data.height - 1 - cell.y) * data.width + cell.x];
    if (area && !found.includes(goals[area - 1]) && shown(goals[area - 1])) found.push(goals[area - 1]);
    if (!cell.there && !area) return hush();
    const list = byId("show-observations").checked ? pairsAt.get(cell.key) || [] : [];
    const nodes = found.flatMap(goalNodes);
    if (list.length) {
      const total = list.reduce((sum, i) => sum + pairs.count[i], 0);
      nodes.push(make("b", { textContent: `Cell (${cell.x}, ${cell.y}): ${count(total, "observation")}` }), ...pairRows(list));
    }
    if (!nodes.length) return hush();
    return tell(nodes, event.clientX, event.clientY);
  }

  function choose(rank) {
    if (state.rank === rank) return;
    state.rank = rank;
    for (const line of document.querySelectorAll("#subgoals tr")) {
      line.classList.toggle("chosen", rank !== null && Number(line.dataset.rank) === rank);
    }
    paintTint();
    draw();
    drawRows();
  }

  function interest(element, goal) {
    const leave = () => { hush(); choose(state.pinned); };
    const show = () => {
      const box = element.getBoundingClientRect();
      choose(goal.rank);
      tell(goalNodes(goal), Math.min(box.right, innerWidth - 40) - 8, box.top + box.height / 2);
    };
    element.addEventListener("pointerenter", (event) => { if (event.pointerType === "mouse") show(); });
    element.addEventListener("pointerleave", leave);
    element.addEventListener("focus", show);
    element.addEventListener("blur", leave);
    element.addEventListener("click", (event) => {
      event.stopPropagation();
      state.pinned = state.pinned === goal.rank ? null : goal.rank;
      choose(state.pinned);
      if (state.pinned !== null) show();
    });
  }

  function makeMarkers() {
    for (const goal of goals.filter((each) => each.rank)) {
      const tag = make("span", { className: "tag", textContent: number(goal.probability) });
      tag.setAttribute("aria-hidden", "true");
      goal.marker = make("button", { className: `marker rank-${goal.rank}`, type: "button" }, String(goal.rank), tag);
      goal.marker.style.zIndex = goals.length - goal.rank; // The first ranks lie on top.
      goal.marker.setAttribute("aria-label", goalLines(goal).join(", "));
      markers.append(goal.marker);
      interest(goal.marker, goal);
      const line = document.querySelector(`#subgoals tr[data-rank="${goal.rank}"]`);
      interest(line, goal);
    }
  }

  function moveStage() {
    const held = new Map();
    let before = null;
    const middle = () => {
      const points = [...held.values()];
      const x = points.reduce((sum, p) => sum + p[0], 0) / points.length;
      const y = points.reduce((sum, p) => sum + p[1], 0) / points.length;
      const spread = points.length > 1 ? Math.hypot(points[0][0] - points[1][0], points[0][1] - points[1][1]) : 0;
      return { x, y, spread };
    };
    stage.addEventListener("pointerdown", (event) => {
      if (event.target.closest(".marker") || event.button > 0) return;
      held.set(event.pointerId, [event.clientX, event.clientY]);
      stage.setPointerCapture(event.pointerId);
      before = middle();
    });
    stage.addEventListener("pointermove", (event) => {
      if (!held.has(event.pointerId)) {
        if (!event.target.closest(".marker")) tellCell(event);
        return;
      }
      held.set(event.pointerId, [event.clientX, event.clientY]);
      const now = middle();
      if (held.size === 1 && Math.hypot(now.x - before.x, now.y - before.y) < 2) return;
      hush();
      stage.classList.add("dragging");
      const box = map.getBoundingClientRect();
      if (before.spread && now.spread) zoom(now.spread / before.spread, now.x - box.left, now.y - box.top);
      move(before.x - now.x, now.y - before.y);
      before = now;
    });
    for (const name of ["pointerup", "pointercancel"]) {
      stage.addEventListener(name, (event) => {
        const still = !stage.classList.contains("dragging");
        held.delete(event.pointerId);
        before = held.size ? middle() : null;
        if (!held.size) stage.classList.remove("dragging");
        if (name === "pointerup" && still && event.pointerType !== "mouse") tellCell(event);
      });
    }
    stage.addEventListener("pointerleave", (event) => { if (event.pointerType === "mouse") hush(); });
    stage.addEventListener("click", (event) => {
      if (!event.target.closest(".marker")) { state.pinned = null; choose(null); }
    });
    stage.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      const box = map.getBoundingClientRect();
      hush();
      zoom(Math.exp(-0.004 * event.deltaY), event.clientX - box.left, event.clientY - box.top);
    }, { passive: false });
    stage.addEventListener("keydown", (event) => {
      const moves = { ArrowLeft: [-60, 0], ArrowRight: [60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] };
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key in moves) move(...moves[event.key]);
      else if (event.key === "+" || event.key === "=") zoom(1.4);
      else if (event.key === "-") zoom(1 / 1.4);
      else if (event.key === "0") { fitAll(); draw(); }
      else if (event.key === "Escape") { hush(); state.pinned = null; choose(null); }
      else return;
      event.preventDefault();
    });
    byId("zoom-in").addEventListener("click", () => zoom(1.4));
    byId("zoom-out").addEventListener("click", () => zoom(1 / 1.4));
    byId("zoom-all").addEventListener("click", () => { fitAll(); draw(); });
    for (const id of ["show-observations", "show-ways"]) byId(id).addEventListener("change", draw);
  }

  function sizeStage() {
    const tallest = Math.max(300, Math.min(0.72 * innerHeight, 640));
    const height = 24 + (stage.clientWidth - 24) * data.height / data.width;
    stage.style.height = `${Math.round(Math.min(Math.max(height, 240), tallest))}px`;
  }

  function writeKey() {
    const entry = (parts, text) => {
      const sign = svg("svg", { viewBox: "0 0 26 16", "aria-hidden": "true" });
      sign.append(...parts);
      return make("li", {}, sign, text);
    };
    const ink = "var(--faint)";
    const first = data.colours[1] || data.colours[0];
    const entries = [
      entry([svg("path", { d: "M2 6h12V3l9 5-9 5v-3H2z", fill: first })], "a move, the wider the more often"),
    ];
    if (data.colours.length > 1) entries[0].append(", in its subgoal\u2019s colour");
    if (pairs.action.includes(0)) entries.push(entry([svg("circle", { cx: 13, cy: 8, r: 4, fill: first })], "staying"));
    if (data.ways.length) {
      entries.push(entry([
        svg("path", { d: "M1 8h20", fill: "none", stroke: ink, "stroke-width": 1.6, "stroke-dasharray": "4 2.5" }),
        svg("path", { d: "M25 8l-6-3.5v7z", fill: ink }),
      ], data.order));
    }
    if (pairs.rank.includes(0)) {
      entries.push(entry([svg("circle", { cx: 13, cy: 8, r: 5, fill: data.colours[0] })], "explained by no subgoal"));
    }
    if (goals.some((goal) => !goal.rank)) {
      entries.push(entry([svg("circle", { cx: 13, cy: 8, r: 6, fill: "none", stroke: ink, "stroke-width": 1.6, "stroke-dasharray": "3 2" })],
        "a candidate beside the subgoals"));
    }
    byId("key").append(...entries);
  }

  // ---- The slider ----

  function drawHistogram() {
    const bars = 50;
    const counts = new Array(bars).fill(0);
    for (const goal of goals) counts[Math.min(Math.max(Math.ceil(goal.probability * bars) - 1, 0), bars - 1)] += 1;
    const most = Math.sqrt(Math.max(1, ...counts));
    const picture = byId("histogram");
    picture.setAttribute("viewBox", `0 0 ${bars} 40`);
    picture.setAttribute("preserveAspectRatio", "none");
    picture.replaceChildren(...counts.map((found, k) => {
      const height = found ? Math.max(38 * Math.sqrt(found) / most, 3) : 0;
      return svg("rect", { x: k + 0.1, y: 40 - height, width: 0.8, height });
    }));
  }

  function listOthers() {
    const others = goals.filter((goal) => !goal.rank && shown(goal));
    const columns = document.querySelectorAll(".subgoals thead th").length;
    const named = new Map([...document.querySelectorAll(".subgoals thead th")].map((th, k) => [th.textContent.trim(), k]));
    const lines = others.slice(0, 30).map((goal) => {
      const cells = Array.from({ length: columns }, () => make("td", { className: "number" }));
      const put = (name, text) => { if (named.has(name)) cells[named.get(name)].textContent = text; };
      cells[0].className = "";
      cells[0].append(make("span", { className: "rank" }));
      put("cell", goal.label);
      put("feature", goal.label);
      put("probability", number(goal.probability));
      if (goal.pursuits !== null) put("pursuits", number(goal.pursuits, 1));
      const line = make("tr", { title: goalLines(goal).join("\n") }, ...cells);
      return line;
    });
    if (others.length > lines.length) {
      const cell = make("td", { colSpan: columns, textContent: `and ${count(others.length - lines.length, "candidate")} more` });
      lines.push(make("tr", {}, cell));
    }
    byId("others").replaceChildren(...lines);
    return others.length;
  }

  function slide() {
    const slider = byId("least");
    state.least = Number(slider.value) / 100;
    const ofMode = goals.filter((goal) => goal.rank);
    const kept = ofMode.filter(shown);
    const text = number(state.least);
    byId("least-text").textContent = text;
    slider.setAttribute("aria-valuetext", text);
    for (const goal of ofMode) document.querySelector(`#subgoals tr[data-rank="${goal.rank}"]`).hidden = !shown(goal);
    const others = listOthers();
    byId("count").textContent = `${kept.length} of ${count(ofMode.length, "subgoal")} of the posterior mode`
      + (goals.length > ofMode.length ? `, and ${others} of ${count(goals.length - ofMode.length, "other candidate")}` : "") + ".";
    [...byId("histogram").children].forEach((bar, k) => bar.classList.toggle("in", (k + 1) / 50 >= state.least - 1e-9));
    paintTint();
    draw();
    drawRows();
  }

  // ---- The order of the visits ----

  const timeline = byId("timeline");
  const rowsCanvas = byId("rows");
  let rowsShown = Math.min(episodes.length, EPISODES_AT_FIRST);
  const longest = Math.max(1, ...episodes.map((episode) => episode.count));
  const LABEL = 38;
  const rowHeight = () => (rowsShown > 12 ? 15 : 20);

  function drawRows() {
    if (!episodes.length) return;
    const step = rowHeight();
    rowsCanvas.style.height = `${rowsShown * step}px`;
    const { pen, width } = sharp(rowsCanvas);
    const ink = colour("--faint");
    const space = width - LABEL;
    pen.font = "11px system-ui, sans-serif";
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    for (let k = 0; k < rowsShown; k += 1) {
      const { number: name, first, count: length } = episodes[k];
      const wide = Math.max(space * length / longest, 1);
      pen.globalAlpha = 1;
      pen.fillStyle = ink;
      pen.fillText(String(name), LABEL - 8, k * step + step / 2);
      const columns = Math.min(Math.ceil(wide * 2), length);
      for (let column = 0; column < columns; column += 1) {
        const start = Math.floor(column * length / columns);
        const end = Math.max(start + 1, Math.floor((column + 1) * length / columns));
        const tally = new Map();
        for (let t = start; t < end; t += 1) {
          const rank = pairs.rank[seen[first + t]];
          tally.set(rank, (tally.get(rank) || 0) + 1);
        }
        const [rank] = [...tally].reduce((a, b) => (b[1] > a[1] ? b : a));
        pen.fillStyle = rankShown(rank) ? data.colours[rank] : colour("--faded");
        pen.globalAlpha = state.rank !== null && state.rank !== rank ? 0.18 : 1;
        const x = LABEL + wide * start / length;
        // Half a pixel more, or the page would shine through between neighbours.
        pen.fillRect(x, k * step + 2, wide * (end - start) / length + (end < length ? 0.5 : 0), step - 4);
      }
    }
    pen.globalAlpha = 1;
    if (state.at !== null) {
      const k = episodes.findIndex((episode) => state.at < episode.first + episode.count);
      if (k < rowsShown) {
        const x = LABEL + space * (state.at - episodes[k].first + 0.5) / longest;
        pen.fillStyle = colour("--card");
        pen.fillRect(x - 2.5, k * step, 5, step);
        pen.fillStyle = colour("--ink");
        pen.fillRect(x - 1, k * step, 2, step);
      }
    }
  }

  function observationText(at) {
    const episode = episodes.find((each) => at < each.first + each.count);
    const i = seen[at];
    const rank = pairs.rank[i];
    const sentences = [
      `Episode ${episode.number}, observation ${at - episode.first + 1} of ${episode.count}: `
      + `${data.actions[pairs.action[i]]} in cell (${pairs.x[i]}, ${pairs.y[i]})`,
      `${purpose(rank)}, probability ${number(pairs.sure[i])}`,
    ];
    const k = data.pursuits.findIndex(([first, last]) => first <= at && at <= last);
    if (k >= 0) {
      const [first, last, of, arrived] = data.pursuits[k];
      sentences.push(`pursuit of subgoal ${of} from ${first - episode.first + 1} to ${last - episode.first + 1}, `
        + (arrived ? "which it reached" : "which it did not reach"));
    }
    return sentences;
  }

  function stand(at) {
    state.at = at;
    const sentences = observationText(at);
    byId("told").textContent = sentences.join("; ");
    timeline.setAttribute("aria-valuenow", String(at + 1));
    timeline.setAttribute("aria-valuetext", sentences.join("; "));
    draw();
    drawRows();
  }

  function moveTimeline() {
    timeline.setAttribute("aria-valuemax", String(seen.length));
    timeline.addEventListener("pointermove", (event) => {
      const box = rowsCanvas.getBoundingClientRect();
      const k = Math.floor((event.clientY - box.top) / rowHeight());
      const episode = episodes[Math.min(Math.max(k, 0), rowsShown - 1)];
      const t = Math.floor((event.clientX - box.left - LABEL) / (box.width - LABEL) * longest);
      if (t < 0 || t >= episode.count) return hush();
      stand(episode.first + t);
      const [head, ...rest] = observationText(state.at);
      return tell([make("b", { textContent: head }), row(pairs.rank[seen[state.at]], rest[0]),
        ...rest.slice(1).map((text) => make("div", { textContent: text }))], event.clientX, event.clientY);
    });
    timeline.addEventListener("pointerleave", hush);
    timeline.addEventListener("keydown", (event) => {
      const at = state.at === null ? 0 : state.at;
      const k = episodes.findIndex((episode) => at < episode.first + episode.count);
      const beside = (next) => {
        const episode = episodes[Math.min(Math.max(next, 0), episodes.length - 1)];
        return episode.first + Math.min(at - episodes[k].first, episode.count - 1);
      };
      const places = {
        ArrowRight: () => (state.at === null ? 0 : at + 1), ArrowLeft: () => at - 1,
        ArrowDown: () => beside(k + 1), ArrowUp: () => beside(k - 1),
        PageDown: () => at + 10, PageUp: () => at - 10,
        Home: () => episodes[k].first, End: () => episodes[k].first + episodes[k].count - 1,
      };
      if (event.key === "Escape") { state.at = null; byId("told").textContent = ""; draw(); drawRows(); return; }
      if (!(event.key in places) || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      const next = Math.min(Math.max(places[event.key](), 0), seen.length - 1);
      const row = episodes.findIndex((episode) => next < episode.first + episode.count);
      if (row >= rowsShown) showEpisodes();
      stand(next);
    });
    const more = byId("more-episodes");
    const showEpisodes = () => { rowsShown = episodes.length; more.hidden = true; drawRows(); };
    more.hidden = rowsShown === episodes.length;
    more.textContent = `Show all ${number(episodes.length, 0)} episodes`;
    more.addEventListener("click", showEpisodes);
  }

  // ---- The traces ----

  function drawTrace(trace) {
    const [wide, high, left, bottom] = [400, 130, 52, 16];
    const values = trace.chains.flat();
    let [low, top] = values.reduce(([a, b], v) => [Math.min(a, v), Math.max(b, v)], [Infinity, -Infinity]);
    if (low === top) { low -= 1; top += 1; }
    const draws = trace.chains[0].length;
    const x = (k) => left + (wide - left) * (draws > 1 ? k / (draws - 1) : 0.5);
    const y = (v) => 6 + (high - bottom - 12) * (top - v) / (top - low);
    const picture = svg("svg", { viewBox: `0 0 ${wide} ${high}`, preserveAspectRatio: "none", role: "img" });
    const summary = `${trace.name} of ${count(trace.chains.length, "chain")}, from ${size(low)} to ${size(top)}`;
    picture.setAttribute("aria-label", summary);
    picture.append(svg("path", { class: "frame", d: `M${left} 2V${high - bottom}H${wide}` }));
    trace.chains.forEach((chain, c) => {
      const d = chain.map((v, k) => `${k ? "L" : "M"}${x(k).toFixed(1)} ${y(v).toFixed(1)}`).join("");
      picture.append(svg("path", { class: `stroke-${c % 4}`, d }));
    });
    const cursor = svg("path", { class: "cursor" });
    picture.append(cursor);
    const axis = svg("svg", { "aria-hidden": "true" });
    const label = (value) => svg("text", { x: "12%", dx: -5, y: `${(100 * y(value)) / high}%`, dy: 4, "text-anchor": "end" }, size(value));
    const words = [label(low), label(top),
      svg("text", { x: "13%", y: "100%", dy: -3 }, "draw 1"),
      svg("text", { x: "100%", y: "100%", dy: -3, "text-anchor": "end" }, String((draws - 1) * trace.every + 1))];
    axis.append(picture, ...words);
    picture.setAttribute("width", "100%");
    picture.setAttribute("height", "100%");
    const told = `R-hat ${trace.rhat}, ESS ${trace.ess}`;
    const figure = make("figure", { className: "trace" }, make("figcaption", {},
      make("b", { textContent: trace.name }), make("span", { textContent: told })), axis);
    axis.addEventListener("pointermove", (event) => {
      const box = axis.getBoundingClientRect();
      const share = ((event.clientX - box.left) / box.width * wide - left) / (wide - left);
      if (share < 0) { hush(); return; }
      const k = Math.min(Math.max(Math.round(share * (draws - 1)), 0), draws - 1);
      cursor.setAttribute("d", `M${x(k)} 2V${high - bottom}`);
      const lines = trace.chains.slice(0, 12).map((chain, c) => {
        const dot = make("span", { className: "dot" });
        dot.style.background = colour(`--chain-${c % 4}`);
        return make("span", { className: "row" }, dot, make("span", { textContent: `chain ${c + 1}: ${size(chain[k])}` }));
      });
      tell([make("b", { textContent: `Draw ${k * trace.every + 1}` }), ...lines], event.clientX, event.clientY);
    });
    axis.addEventListener("pointerleave", () => { hush(); cursor.setAttribute("d", ""); });
    return figure;
  }

  // ---- All together ----

  function repaint() {
    if (ground.complete) blocked = painted(ground, colour("--blocked"));
    paintTint();
    draw();
    drawRows();
  }

  function start() {
    makeMarkers();
    writeKey();
    for (const id of ["tools", "slider"]) byId(id).hidden = false;
    byId("timeline-part").hidden = !seen.length;
    byId("traces").append(...data.traces.map(drawTrace));
    drawHistogram();
    sizeStage();
    fitSeen();
    moveStage();
    moveTimeline();
    // At first nothing of the mode is hidden.
    const lowest = Math.min(0.5, ...goals.filter((goal) => goal.rank).map((goal) => goal.probability));
    byId("least").value = Math.max(1, Math.floor(100 * lowest + 1e-9));
    byId("least").addEventListener("input", slide);
    slide();
    let wide = stage.clientWidth;
    new ResizeObserver(() => {
      if (stage.clientWidth === wide) return;
      const before = wide;
      wide = stage.clientWidth;
      sizeStage();
      if (before && wide) view.scale *= wide / before;
      draw();
      drawRows();
    }).observe(stage);
    for (const query of ["(prefers-color-scheme: dark)", "print"]) matchMedia(query).addEventListener("change", repaint);
    addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((part) => { part.open = true; }));
    addEventListener("scroll", hush, { passive: true });
    addEventListener("keydown", (event) => { if (event.key === "Escape") hush(); });
    ground.addEventListener("load", repaint);
    ground.src = data.map;
    if (data.areas) {
      const image = new Image();
      image.addEventListener("load", () => {
        const canvas = make("canvas", { width: data.width, height: data.height });
        const pen = canvas.getContext("2d");
        pen.drawImage(image, 0, 0);
        const { data: bytes } = pen.getImageData(0, 0, data.width, data.height);
        areas = Uint32Array.from({ length: bytes.length / 4 }, (_, i) => bytes[4 * i] + 256 * bytes[4 * i + 1] + 65536 * bytes[4 * i + 2]);
        repaint();
      });
      image.src = data.areas;
    }
    document.documentElement.dataset.ready = "true";
  }

  start();
})();
