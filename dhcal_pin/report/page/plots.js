// Plots whose dots are samples: dots and vertical axis follow what is shown, and a dot can be selected.

const SVG = "http://www.w3.org/2000/svg";
const MEDIAN_PARTS = 12, MIN_PART_SAMPLES = 5;   // as in visualization/plots.py
const NEAR = 14;                                 // largest distance of the pointer from a dot [px of the plot]

const shape = (tag, attributes, text) => {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  if (text !== undefined) node.textContent = text;
  return node;
};

/** Round numbers from zero to a largest value. */
function ticks(largest) {
  const rough = largest / 4, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 2.5, 5, 10].find(k => k * power >= rough * 0.999);
  const decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9) + (String(step / power) === "2.5" ? 1 : 0));
  return Array.from({ length: Math.floor(largest / step + 1e-9) + 1 }, (_, k) => [k * step, (k * step).toFixed(decimals)]);
}

const median = values => {
  const sorted = Float64Array.from(values).sort(), middle = sorted.length >> 1;
  return sorted.length % 2 ? sorted[middle] : (sorted[middle - 1] + sorted[middle]) / 2;
};

class SamplePlot {
  constructor(box, selection, announce) {
    Object.assign(this, { box, selection, announce, samples: selection.samples });
    this.svg = box.querySelector("svg");
    const numbers = name => this.svg.dataset[name].split(" ").map(Number);
    [this.left, this.top, this.right, this.bottom] = numbers("frame");
    this.xLimits = numbers("x");
    this.yLimits = numbers("y");
    this.isError = box.dataset.y.startsWith("error:");
    this.x = this.samples.column(box.dataset.x);
    this.order = [...this.x.keys()].filter(i => Number.isFinite(this.x[i])).sort((a, b) => this.x[a] - this.x[b]);
    box.classList.add("live");
    this.layer = shape("g", {});
    this.marks = shape("g", {});
    this.brush = shape("rect", { class: "brush", width: 0, height: 0 });
    if (this.isError) {
      const label = this.svg.querySelector(".y-axis");
      this.label = [...label.querySelectorAll("text")].at(-1).cloneNode(true);
      label.remove();
      for (const old of this.svg.querySelectorAll(".samples")) old.remove();
    }
    this.svg.append(this.layer, this.marks, this.brush);
    const caption = box.closest("figure").querySelector("figcaption").textContent;
    Object.assign(box, { tabIndex: 0, role: "application" });
    box.setAttribute("aria-label", `${caption}: plot of samples. Arrow keys go from sample to sample, Enter selects one, Escape ends.`);
    this.listen();
    this.draw();
    selection.views.push(change => "hovered" in change || "current" in change ? this.mark() : this.draw());
  }
  get states() { return !this.isError ? ["after"] : this.selection.state === "both" ? ["before", "after"] : [this.selection.state]; }
  toX(value) { return this.left + (value - this.xLimits[0]) / (this.xLimits[1] - this.xLimits[0]) * (this.right - this.left); }
  toY(value) { return this.bottom - (value - this.yLimits[0]) / (this.yLimits[1] - this.yLimits[0]) * (this.bottom - this.top); }

  /** Draws dots and vertical axis for what is shown. */
  draw() {
    const { samples, selection } = this, shown = this.order.filter(i => selection.isShown(i));
    this.y = Object.fromEntries(this.states.map(state => [state, samples.column(this.box.dataset.y, state)]));
    this.layer.replaceChildren();
    if (this.isError) this.drawAxis(shown);
    const layers = {};
    for (const state of this.states)
      for (const i of shown) {
        if (!Number.isFinite(this.y[state][i])) continue;
        const color = samples.outlier[i] ? "outlier" : state === "before" ? "before"
          : samples.roles.length > 1 ? samples.roleOf(i) === "fitted" ? "sample" : "holdout" : this.isError ? "after" : "measured";
        const key = `${color} ${samples.outlier[i] ? 5 : shown.length < 100 ? 5 : this.isError ? 3 : 2.6}`;
        (layers[key] ??= []).push(`M${this.toX(this.x[i]).toFixed(1)} ${this.toY(this.y[state][i]).toFixed(1)}h0`);
      }
    const last = key => key.startsWith("outlier") ? 1 : 0;
    for (const [key, parts] of Object.entries(layers).sort(([a], [b]) => last(a) - last(b))) {
      const [color, width] = key.split(" ");
      if (this.isError || color === "outlier")
        this.layer.append(shape("path", { class: "dot", d: parts.join(""), style: `stroke:var(--${color});stroke-width:${width}` }));
    }
    if (this.box.dataset.x.startsWith("joint:") && this.isError) this.drawMedians(shown);
    this.mark();
  }
  drawAxis(shown) {
    const largest = Math.max(...this.states.map(state => shown.reduce((most, i) => Math.max(most, this.y[state][i] || 0), 0))) || 1;
    this.yLimits = [0, 1.05 * largest];
    for (const [value, text] of ticks(this.yLimits[1])) {
      const y = this.toY(value).toFixed(2);
      this.layer.append(shape("path", { class: "grid", d: `M${this.left} ${y}H${this.right}` }),
        shape("text", { x: this.left - 4, y: Number(y) + 4, "text-anchor": "end" }, text));
    }
    this.layer.append(this.label);
  }
  drawMedians(shown) {
    const xs = shown.map(i => this.x[i]), low = Math.min(...xs), width = (Math.max(...xs) - low) / MEDIAN_PARTS;
    for (const state of this.states) {
      const parts = Array.from({ length: MEDIAN_PARTS }, () => []);
      for (const i of shown)
        if (Number.isFinite(this.y[state][i])) parts[Math.min(MEDIAN_PARTS - 1, Math.floor((this.x[i] - low) / width)) || 0].push(this.y[state][i]);
      const line = parts.flatMap((values, k) => values.length < MIN_PART_SAMPLES ? []
        : [`${this.toX(low + (k + 0.5) * width).toFixed(1)} ${this.toY(median(values)).toFixed(1)}`]);
      if (line.length > 1) this.layer.append(shape("path", { class: "median", d: `M${line.join("L")}` }));
    }
  }
  /** Marks the selected samples and the one under the pointer. */
  mark() {
    const { current, hovered, chosen } = this.selection;
    const state = this.states.at(-1), at = i => [this.toX(this.x[i]), this.toY(this.y[state][i])];
    this.marks.replaceChildren();
    const canMark = i => i !== null && this.selection.isShown(i) && at(i).every(Number.isFinite);
    if (chosen) this.marks.append(shape("path", { class: "picked", d: [...chosen].filter(canMark).map(i => `M${at(i).map(v => v.toFixed(1)).join(" ")}h0`).join("") }));
    for (const [i, radius] of [[hovered, 5], [current, 7]])
      if (canMark(i)) this.marks.append(shape("circle", { class: "ring", cx: at(i)[0], cy: at(i)[1], r: radius }));
  }

  position(event) {
    const box = this.svg.getBoundingClientRect(), scale = this.svg.viewBox.baseVal.width / box.width;
    return [(event.clientX - box.left) * scale, (event.clientY - box.top) * scale];
  }
  /** Sample whose dot is nearest to a position; null if none is near. */
  nearest([px, py]) {
    let found = null, least = NEAR ** 2;
    for (const state of this.states)
      for (const i of this.order) {
        if (!this.selection.isShown(i)) continue;
        const distance = (this.toX(this.x[i]) - px) ** 2 + (this.toY(this.y[state][i]) - py) ** 2;
        if (distance < least) [found, least] = [i, distance];
      }
    return found;
  }
  inside([x0, y0], [x1, y1]) {
    const isBetween = (value, a, b) => value >= Math.min(a, b) && value <= Math.max(a, b);
    return new Set(this.order.filter(i => this.selection.isShown(i) && this.states.some(state =>
      isBetween(this.toX(this.x[i]), x0, x1) && isBetween(this.toY(this.y[state][i]), y0, y1))));
  }
  listen() {
    let start = null, isDragging = false;
    const { svg, box, selection } = this;
    svg.addEventListener("pointerdown", event => {
      if (event.button) return;
      start = this.position(event);
      isDragging = false;
      if (event.pointerType === "mouse") svg.setPointerCapture(event.pointerId);
    });
    svg.addEventListener("pointermove", event => {
      const now = this.position(event);
      if (start && event.pointerType === "mouse" && (isDragging || Math.hypot(now[0] - start[0], now[1] - start[1]) > 6)) {
        isDragging = true;
        const [x, y] = [0, 1].map(k => Math.min(start[k], now[k])), [width, height] = [0, 1].map(k => Math.abs(start[k] - now[k]));
        for (const [name, value] of Object.entries({ x, y, width, height })) this.brush.setAttribute(name, value);
        return;
      }
      const hovered = this.nearest(now);
      if (hovered !== selection.hovered) selection.update({ hovered });
      this.announce(hovered, event);
    });
    svg.addEventListener("pointerup", event => {
      if (start === null) return;
      const now = this.position(event), from = start;
      start = null;
      if (isDragging) {
        this.brush.setAttribute("width", 0);
        const chosen = this.inside(from, now);
        selection.update({ chosen: chosen.size ? chosen : null });
      } else {
        const near = this.nearest(now);
        if (near !== null) selection.update({ current: near });
        else if (selection.chosen) selection.update({ chosen: null });
      }
    });
    svg.addEventListener("pointerleave", () => { if (selection.hovered !== null) selection.update({ hovered: null }); this.announce(null); });
    box.addEventListener("keydown", event => {
      const shown = this.order.filter(i => selection.isShown(i) && Number.isFinite(this.y[this.states.at(-1)][i]));
      const at = shown.indexOf(selection.hovered ?? selection.current);
      const step = { ArrowRight: 1, ArrowLeft: -1, PageUp: 10, PageDown: -10 }[event.key];
      if (step && shown.length) selection.update({ hovered: shown[at < 0 ? 0 : Math.min(shown.length - 1, Math.max(0, at + step))] });
      else if (event.key === "Enter" && selection.hovered !== null) selection.update({ current: selection.hovered });
      else if (event.key === "Escape") selection.update({ hovered: null, current: null, chosen: null });
      else return;
      event.preventDefault();
      const i = selection.hovered, frame = svg.getBoundingClientRect();
      const scale = frame.width / svg.viewBox.baseVal.width;
      this.announce(i, i === null ? null : { clientX: frame.left + scale * this.toX(this.x[i]), clientY: frame.top + scale * this.toY(this.y[this.states.at(-1)][i]) });
    });
    box.addEventListener("blur", () => { if (selection.hovered !== null) selection.update({ hovered: null }); this.announce(null); });
  }
}
