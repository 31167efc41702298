// Panels over time. Each is made when it comes into sight, or when there is nothing else to do.

const TICKS = () => new Bokeh.BasicTickFormatter({ use_scientific: false });
const POWERS = () => new Bokeh.CustomJSTickFormatter({
  code: "const round = Number(tick.toPrecision(6)); return round >= 1e4 ? round / 1000 + 'k' : String(round)",
});
const touches = matchMedia("(pointer: coarse)").matches;

class Panel {
  constructor(spec, place) {
    this._read(spec);
    this.element = make("figure", "panel");
    const head = make("figcaption");
    const name = spec.unit && !spec.gate && !this.dots.length ? `${spec.title} [${spec.unit}]` : spec.title;
    head.append(make("b", "", name));
    this.told = make("span", "told");
    head.append(this.told);
    this.plot = make("div", "plot");
    this.plot.setAttribute("role", "img");
    this.plot.setAttribute("aria-label", `${name} over time`);
    this.cursor = make("div", "cursor");
    this.plot.append(this.cursor);
    this.element.append(head, this.plot);
    place.append(this.element);
    this.inSight = false;
    this.stale = false; // limits and who is shown
    this.old = false; // numbers
    this._heed();
  }

  _read(spec) {
    this.spec = spec;
    this.lines = spec.lines.map((line) => ({
      ...line, t: numbers(line.t), y: numbers(line.y),
      band: line.band && this._band_of(line.band),
    }));
    this.dots = (spec.dots || []).map((one) => ({
      ...one, t: numbers(one.t), y: one.y.map(numbers), raw: one.raw.map(numbers),
      not_used: one.not_used.map((part) => ({ ...part, t: numbers(part.t), y: numbers(part.y) })),
    }));
  }

  /** A band: so far to both sides of its line, or from low to high. */
  _band_of({ t, half, low, high, about }) {
    return half ? { t: numbers(t), half: numbers(half), about } : { t: numbers(t), low: numbers(low), high: numbers(high) };
  }

  /** What a plot consists of, but for its numbers. */
  _parts() {
    const lines = this.lines.map(({ of, name, dashed, band }) => [of, name, dashed, Boolean(band)]);
    const dots = this.dots.map(({ of, axes, not_used }) => [of, axes, not_used.map(({ outcome }) => outcome)]);
    return JSON.stringify([lines, dots, this._shaded().length, this.spec.gate, this.spec.limit]);
  }

  /** Show newer contents of the same panel, as soon as somebody looks. */
  grow(spec) {
    const before = this._parts();
    this._read(spec);
    if (!this.made) return;
    if (this._parts() != before) {
      this.made = this.made.then(() => {
        this.view.remove();
        return this._build();
      });
    } else {
      this.old = true;
      this.update();
    }
  }

  async build() {
    if (this.made) return this.made;
    this.made = this._build();
    return this.made;
  }

  async _build() {
    const range = new Bokeh.Range1d({ start: seen.start, end: seen.end });
    this.figure = new Bokeh.Plotting.figure({
      height: 170, sizing_mode: "stretch_width", toolbar_location: null, tools: [], x_range: range,
      y_range: new Bokeh.Range1d({ start: 0, end: 1 }), y_axis_type: this.spec.log ? "log" : "linear",
      min_border_left: 58, min_border_right: 14, min_border_top: 4, min_border_bottom: 24, lod_threshold: null,
      x_axis_label: this.spec.last ? PAGE.axis : null,
    });
    this.figure.yaxis.formatter = this.spec.log ? POWERS() : TICKS();
    this.figure.xaxis.formatter = TICKS();
    this.figure.yaxes[0].ticker.desired_num_ticks = 5;
    this.parts = []; // [subject, renderer, whether it is a band]
    this.themed = []; // what has another colour in the dark
    this.fresh = []; // what takes over newer numbers
    this._shade();
    const order = [...this.lines.keys()];
    for (const k of order) if (this.lines[k].band) this._band(k);
    for (const k of order.sort((a, b) => (this.lines[a].of < 0) - (this.lines[b].of < 0))) this._line(k);
    for (const k of this.dots.keys()) this._dots(k);
    if (!touches) gestures(this.figure, "width");
    this.theme();
    this.update();
    range.change.connect(() => {
      if (!this.updating) setStretch(range.start, range.end);
    });
    this.view = await Bokeh.Plotting.show(this.figure, this.plot);
    this.follow();
  }

  /** When there was no fix or a fault: from, to, and which. */
  _shaded() {
    const { sensors } = this.spec;
    const faults = PAGE.faults.filter(({ sensor }) => !sensors || sensors.includes(sensor));
    return [...PAGE.windows.map(([start, end]) => [start, end, "denied"]),
      ...faults.map(({ start, end }) => [start, end, "fault"])];
  }

  _shade() {
    this._shaded().forEach(([left, right, what], k) => {
      const box = new Bokeh.BoxAnnotation({ left, right, fill_alpha: what == "denied" ? 1 : 0.7, line_color: null });
      box.level = "image";
      this.figure.add_layout(box);
      this.themed.push(() => box.setv({ fill_color: colours()[this._shaded()[k][2]] }));
      this.fresh.push(() => {
        const [start, end] = this._shaded()[k];
        box.setv({ left: start, right: end });
      });
    });
    if (this.spec.bounds) {
      const [bottom, top] = this.spec.bounds;
      const box = new Bokeh.BoxAnnotation({ bottom, top, fill_alpha: 0.85, line_color: null, level: "image" });
      this.figure.add_layout(box);
      this.themed.push(() => box.setv({ fill_color: colours().good }));
    }
    const gate = this.spec.gate;
    const levels = [[this.spec.level, "solid"], [gate, "dashed"], [gate && -gate, "dashed"]];
    for (const [location, line_dash] of levels) {
      if (location === undefined || location === null) continue;
      const span = new Bokeh.Span({ location, dimension: "width", line_dash, line_width: 1, level: "underlay" });
      this.figure.add_layout(span);
      this.themed.push(() => span.setv({ line_color: colours().guide }));
    }
  }

  _add(of, renderer, keys, band = false) {
    this.parts.push([of, renderer, band]);
    this.themed.push(() => {
      for (const key of keys) renderer.glyph.setv({ [key]: colourOf(of) });
    });
  }

  /** A source of what `columns` gives, now and whenever there are newer numbers. */
  _source(columns) {
    const source = new Bokeh.ColumnDataSource({ data: columns() });
    this.fresh.push(() => (source.data = columns()));
    return source;
  }

  _line(k) {
    const source = this._source(() => {
      const line = this.lines[k];
      return { t: line.t, y: this.spec.wraps ? this._broken(line) : line.y };
    });
    const line = this.lines[k];
    this._add(line.of, this.figure.line({ field: "t" }, { field: "y" }, { source, ...stroke(line.of, line.dashed) }), ["line_color"]);
  }

  /** A turn through north is no line across the axes. */
  _broken(line) {
    const y = line.y.slice();
    for (let k = 1; k < y.length; k++) if (Math.abs(line.y[k] - line.y[k - 1]) > this.spec.wraps / 2) y[k] = NaN;
    return y;
  }

  _band(own) {
    const source = this._source(() => {
      const { y, band: { t, half, about, low, high } } = this.lines[own];
      if (!half) return { t, low, high };
      const middle = (k) => about ?? y[k];
      return { t, low: half.map((h, k) => middle(k) - h), high: half.map((h, k) => middle(k) + h) };
    });
    const style = { source, fill_alpha: 0.16 };
    const renderer = this.figure.varea({ field: "t" }, { field: "low" }, { field: "high" }, style);
    this._add(this.lines[own].of, renderer, ["fill_color"], true);
  }

  _dots(own) {
    const one = this.dots[own];
    const limit = 0.97 * this.spec.limit;
    const held = (values) => values.map((y) => Math.min(Math.max(Number.isNaN(y) ? -limit : y, -limit), limit));
    const markers = ["circle", "square", "triangle"];
    one.y.forEach((_, k) => {
      const source = this._source(() => ({ t: this.dots[own].t, y: held(this.dots[own].y[k]) }));
      const style = { source, size: 3, line_color: null, fill_alpha: 0.55, marker: markers[k % 3] };
      this._add(one.of, this.figure.scatter({ field: "t" }, { field: "y" }, style), ["fill_color"]);
    });
    one.not_used.forEach((part, k) => {
      const source = this._source(() => {
        const { t, y } = this.dots[own].not_used[k];
        return { t, y: held(y) };
      });
      const style = { source, size: 7, line_width: 1.6, marker: "x" };
      const renderer = this.figure.scatter({ field: "t" }, { field: "y" }, style);
      this.parts.push([one.of, renderer, false]);
      const { light, dark: lighter } = PAGE.outcomes[part.outcome];
      this.themed.push(() => renderer.glyph.setv({ line_color: dark() ? lighter : light }));
    });
  }

  theme() {
    if (!this.figure) return;
    dress(this.figure);
    for (const paint of this.themed) paint();
  }

  /** Stretch, limits and who is shown, as they are now; later if nobody looks. */
  update() {
    if (!this.figure) return;
    if (this.view && !this.inSight) {
      this.stale = true;
      return;
    }
    this.stale = false;
    this.updating = true;
    if (this.old) for (const take of this.fresh) take();
    this.old = false;
    for (const [of, renderer, band] of this.parts) {
      const visible = !seen.hidden.has(of) && (!band || seen.bands);
      if (renderer.visible != visible) renderer.visible = visible;
    }
    this.figure.x_range.setv({ start: seen.start, end: seen.end });
    const [start, end] = this.limits();
    this.figure.y_range.setv({ start, end });
    this.updating = false;
  }

  // --- how far the vertical axis reaches

  limits() {
    if (this.spec.limit) return [-this.spec.limit, this.spec.limit];
    if (this.spec.wraps) return [0, this.spec.wraps];
    const own = this.lines
      .filter((line) => !seen.hidden.has(line.of))
      .map((line) => ({ of: line.of, ...this._extent(line) }))
      .filter(({ low, high }) => low <= high);
    this.beyond = [];
    if (!own.length) return this.spec.log ? [0.1, 10] : [-1, 1];
    if (this.spec.log) return this._logarithmic(own);
    const kept = this._within(own);
    const low = Math.min(...kept.map((one) => one.low));
    const high = Math.max(...kept.map((one) => one.high));
    if (!this.spec.near) {
      const reach = 1.1 * Math.max(-low, high, 1e-9);
      return [-reach, reach];
    }
    const margin = Math.max(0.08 * (high - low), 1e-4 * Math.abs(high), 1e-6);
    return [low - margin, high + margin];
  }

  /** All but those who are so far off that nothing would be seen of the others. */
  _within(own) {
    const size = (one) => (this.spec.near ? one.high - one.low : Math.max(-one.low, one.high));
    const truth = own.find((one) => one.of < 0 && this.spec.near);
    const least = truth ? Math.max(size(truth), 1) : Math.min(...own.map(size));
    const kept = own.filter((one) => one.of < 0 || size(one) <= FAR * least);
    this.beyond = own.filter((one) => !kept.includes(one)).map((one) => one.of);
    return kept;
  }

  _logarithmic(own) {
    const low = Math.min(...own.map((one) => Math.max(one.low / 1.3, one.median / 20)));
    const high = 2 * Math.max(...own.map((one) => one.high));
    const [least, most] = this.spec.bounds ? [0.05, 10] : [high / 20, 0];
    return [Math.max(Math.min(low, least), 1e-6), Math.max(high, most, 1e-5)];
  }

  /** The lowest, highest and middle value in the stretch, bands about zero included. */
  _extent({ t, y, band, since }) {
    const from = since !== undefined && since < seen.end ? Math.max(seen.start, since) : seen.start;
    let [low, high] = [Infinity, -Infinity];
    const values = [];
    for (let k = after(t, from); k < t.length && t[k] <= seen.end; k++) {
      if (Number.isNaN(y[k])) continue;
      if (y[k] < low) low = y[k];
      if (y[k] > high) high = y[k];
      if (this.spec.log) values.push(y[k]);
    }
    if (band && !band.half && seen.bands)
      for (let k = after(band.t, from); k < band.t.length && band.t[k] <= seen.end; k++) {
        if (band.high[k] > high) high = band.high[k];
        if (band.low[k] < low) low = band.low[k];
      }
    if (band && band.about !== undefined && seen.bands)
      for (let k = after(band.t, from); k < band.t.length && band.t[k] <= seen.end; k++) {
        if (band.half[k] > high) high = band.half[k];
        if (-band.half[k] < low) low = -band.half[k];
      }
    return { low, high, median: Float32Array.from(values).sort()[values.length >> 1] };
  }

  // --- the cursor

  _heed() {
    this.plot.addEventListener("pointermove", (event) => {
      if (event.pointerType == "mouse") this._point(event);
    });
    this.plot.addEventListener("click", (event) => this._point(event));
    this.plot.addEventListener("pointerleave", () => hideTip());
    this.plot.addEventListener("dblclick", () => setStretch(PAGE.start, PAGE.end));
  }

  _point(event) {
    if (!this.view) return;
    const { left, width } = this.view.frame.bbox;
    const share = (event.clientX - this.plot.getBoundingClientRect().left - left) / width;
    if (share < 0 || share > 1) return hideTip();
    setCursor(seen.start + share * (seen.end - seen.start));
    showTip(event, [[null, timeText(seen.cursor), ""], ...this.values()]);
  }

  /** Colour, name and value with its unit of everything that is shown, at the cursor. */
  values() {
    const found = [];
    for (const { of, name, t, y, band } of this.lines) {
      if (seen.hidden.has(of)) continue;
      const k = nearest(t, seen.cursor);
      const j = band && seen.bands ? nearest(band.t, seen.cursor) : -1;
      const value = k < 0 ? "–" : `${text(y[k])}${j < 0 ? "" : this._reach(band, j)} ${this.spec.unit}`;
      found.push([colourOf(of), name ?? PAGE.subjects[of].name, value]);
    }
    for (const { of, axes, t, y, raw, refused } of this.dots) {
      if (seen.hidden.has(of)) continue;
      const k = nearest(t, seen.cursor);
      const joined = (columns) => columns.map((column) => text(column[k])).join(", ");
      const said = k < 0 ? "–" : `${joined(y)} σ (${joined(raw)} ${this.spec.unit})`;
      const name = `${PAGE.subjects[of].name} ${axes.filter(Boolean).join(", ")}`.trim();
      found.push([colourOf(of), name, `${said}; ${(100 * refused).toFixed(2)} % not used`]);
    }
    return found;
  }

  _reach({ half, low, high }, k) {
    return half ? ` ± ${text(half[k])}` : ` (${text(low[k])} – ${text(high[k])})`;
  }

  follow() {
    if (!this.view || !this.inSight) return;
    const { left, top, width, height } = this.view.frame.bbox;
    const share = (seen.cursor - seen.start) / (seen.end - seen.start);
    this.cursor.hidden = share < 0 || share > 1;
    this.cursor.style.cssText = `transform:translateX(${left + share * width}px);top:${top}px;height:${height}px`;
    this.told.replaceChildren();
    for (const [colour, name, value] of this.values()) {
      const one = make("span", "", `${this.dots.length ? name : ""} ${value}`.trim());
      one.title = name;
      one.style.setProperty("--own", colour);
      this.told.append(one);
    }
    for (const of of this.beyond || []) this.told.append(make("em", "", `${PAGE.subjects[of].name} is far beyond`));
  }
}

/** Of lines that lie on each other each shows beside those above it: the first is the widest, truth the thinnest. */
function stroke(of, dashed = false) {
  if (of < 0 || dashed) return { line_width: 1.1, line_dash: dashed ? [6, 4] : "solid" };
  const below = PAGE.subjects.length - 1 - of;
  return { line_width: 1.4 + Math.min(1.2, 4 / PAGE.subjects.length) * below, line_dash: DASHES[PAGE.subjects[of].dash] };
}

// --- tools of the mouse: dragging zooms or moves, the wheel zooms with Ctrl held

const gestured = [];
function gestures(figure, dimensions) {
  const zooms = new Bokeh.BoxZoomTool({ dimensions, match_aspect: dimensions == "both" });
  const pans = new Bokeh.PanTool({ dimensions });
  const wheel = new Bokeh.WheelZoomTool({ dimensions, modifiers: { ctrl: true } });
  figure.add_tools(zooms, pans, wheel);
  figure.toolbar.active_scroll = wheel;
  const choose = () => {
    figure.toolbar.active_drag = seen.pans ? pans : zooms;
    pans.active = seen.pans;
    zooms.active = !seen.pans;
  };
  gestured.push(choose);
  choose();
}

// --- what is under the pointer

const tip = make("div", "tip");
tip.hidden = true;
function hideTip() {
  tip.hidden = true;
}
function showTip(event, rows) {
  tip.replaceChildren(
    ...rows.map(([colour, name, value]) => {
      const row = make("div");
      if (colour) row.style.setProperty("--own", colour);
      row.append(make("span", colour ? "key" : "", name), make("b", "", value));
      return row;
    }),
  );
  tip.hidden = false;
  const { width, height } = tip.getBoundingClientRect();
  const room = document.documentElement.clientWidth;
  const left = event.clientX + 16 + width < room ? event.clientX + 16 : Math.max(4, event.clientX - 16 - width);
  const top = Math.min(event.clientY + 16, innerHeight - height - 4);
  tip.style.transform = `translate(${left}px, ${top}px)`;
}
