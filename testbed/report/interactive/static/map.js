// The map, and beside it the errors at the cursor with the ellipses that are claimed of them.

const CORNERS = 72;
const [LEAST_SIDE, ASTRAY] = [10, 3]; // of what is shown [m]; estimates are, to so many times the side of the reference
const markersAt = (source, points) =>
  (source.data = { x: points.map((p) => p.x), y: points.map((p) => p.y), colour: points.map((p) => p.colour) });

/** Corners of the ellipse of a covariance about a point; x is east, y is north. */
function ellipse([nn, ne, ee], x, y, sigmas) {
  const mean = (nn + ee) / 2;
  const apart = Math.hypot((nn - ee) / 2, ne);
  const [long, short] = [Math.sqrt(Math.max(mean + apart, 0)), Math.sqrt(Math.max(mean - apart, 0))];
  const angle = Math.atan2(2 * ne, nn - ee) / 2; // of the long axis, from north to east
  const corners = { x: [], y: [], long: sigmas * long, short: sigmas * short };
  for (let k = 0; k <= CORNERS; k++) {
    const turn = (2 * Math.PI * k) / CORNERS;
    const [along, across] = [corners.long * Math.cos(turn), corners.short * Math.sin(turn)];
    corners.y.push(y + along * Math.cos(angle) - across * Math.sin(angle));
    corners.x.push(x + along * Math.sin(angle) + across * Math.cos(angle));
  }
  return corners;
}

/** The same values, straight on between those that are known: a log knows none while its reference is silent. */
function bridged(t, values) {
  const known = [...values.keys()].filter((k) => Number.isFinite(values[k]));
  let next = 0; // of those that are known
  return Array.from(values, (value, k) => {
    while (known[next] < k) next += 1;
    const [before, after] = [known[next - 1], known[next]];
    if (after == k || before == undefined || after == undefined) return value;
    return values[before] + ((values[after] - values[before]) * (t[k] - t[before])) / (t[after] - t[before]);
  });
}

/** The box about all known places of tracks, and its longer side; west is beyond east where none is known. */
function extent(tracks) {
  let [west, east, south, north] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const { n, e } of tracks)
    for (let k = 0; k < n.length; k++) {
      if (!(Number.isFinite(n[k]) && Number.isFinite(e[k]))) continue;
      [west, east] = [Math.min(west, e[k]), Math.max(east, e[k])];
      [south, north] = [Math.min(south, n[k]), Math.max(north, n[k])];
    }
  return { west, east, south, north, side: Math.max(east - west, north - south) };
}

/** A square view of places; ranges are set so that a metre is as long in both directions. */
class Plane {
  constructor(place, name, x_axis_label, y_axis_label) {
    this.element = make("figure", "plane");
    this.caption = make("figcaption");
    this.caption.append(make("b", "", name));
    this.told = make("span", "told");
    this.caption.append(this.told);
    this.plot = make("div", "plot");
    this.plot.setAttribute("role", "img");
    this.plot.setAttribute("aria-label", name);
    this.element.append(this.caption, this.plot);
    place.append(this.element);
    this.figure = new Bokeh.Plotting.figure({
      height: 420, sizing_mode: "stretch_width", toolbar_location: null, tools: [], x_axis_label, y_axis_label,
      x_range: new Bokeh.Range1d({ start: -1, end: 1 }), y_range: new Bokeh.Range1d({ start: -1, end: 1 }),
      min_border_right: 10, min_border_top: 4, lod_threshold: null,
    });
    this.figure.xaxis.formatter = TICKS();
    this.figure.yaxis.formatter = TICKS();
    this.parts = []; // [subject, renderer]
    this.themed = [];
    this.fresh = []; // what takes over newer numbers
  }

  source(data = { x: [], y: [], colour: [] }) {
    return new Bokeh.ColumnDataSource({ data });
  }

  /** A source of what `columns` gives, now and whenever there are newer numbers. */
  growing(columns) {
    const source = this.source(columns());
    this.fresh.push(() => (source.data = columns()));
    return source;
  }

  line(of, columns, style = {}) {
    const source = this.growing(columns);
    const renderer = this.figure.line({ field: "x" }, { field: "y" }, { source, ...style });
    if (!style.line_color) this.themed.push(() => renderer.glyph.setv({ line_color: colourOf(of) }));
    this.parts.push([of, renderer]);
    return renderer;
  }

  guides() {
    for (const dimension of ["width", "height"]) {
      const span = new Bokeh.Span({ location: 0, dimension, line_width: 1, level: "underlay" });
      this.figure.add_layout(span);
      this.themed.push(() => span.setv({ line_color: colours().guide }));
    }
  }

  theme() {
    dress(this.figure);
    for (const paint of this.themed) paint();
  }

  shown() {
    for (const [of, renderer] of this.parts) renderer.visible = !seen.hidden.has(of);
  }

  async show() {
    this.theme();
    this.shown();
    this.view = await Bokeh.Plotting.show(this.figure, this.plot);
  }

  /** Show a box around a point, at least so far in both directions. */
  fit(x, y, half_x, half_y = half_x) {
    const { width, height } = this.view ? this.view.frame.bbox : { width: 400, height: 400 };
    const metres = Math.max(half_x / Math.max(width, 1), half_y / Math.max(height, 1), 1e-9);
    this.figure.x_range.setv({ start: x - metres * width, end: x + metres * width });
    this.figure.y_range.setv({ start: y - metres * height, end: y + metres * height });
  }
}

class Chart extends Plane {
  constructor(place, spec) {
    super(place, "Map", "east of the start [m]", "north of the start [m]");
    this._read(spec);
    this.sigmas = spec.sigmas;
    this.follows = false;
    this._denied();
    for (const k of this.fixes.keys()) this._fixes(k);
    const way = (kind, k) => () => ({ x: this[kind][k].e, y: this[kind][k].n });
    this.tracks.forEach(({ of }, k) => this.line(of, way("tracks", k), stroke(of)));
    this.truths.forEach((_, k) => this.line(-1, way("truths", k), stroke(-1)));
    for (const k of this.truths.keys()) this._ends(k);
    this.around = this.source({ x: [], y: [], colour: [] });
    const outlines = { source: this.around, line_color: { field: "colour" }, fill_color: { field: "colour" } };
    this.figure.patches({ field: "x" }, { field: "y" }, { ...outlines, fill_alpha: 0.12, line_width: 1.5 });
    this.here = this.source();
    const style = { source: this.here, size: 11, fill_color: { field: "colour" }, line_color: "#FFFFFF", line_width: 1.5 };
    this.figure.scatter({ field: "x" }, { field: "y" }, style);
    if (!touches) gestures(this.figure, "both");
    this._buttons();
    this.plot.addEventListener("pointermove", (event) => event.pointerType == "mouse" && this._point(event));
    this.plot.addEventListener("click", (event) => this._point(event));
    this.plot.addEventListener("pointerleave", () => hideTip());
    this.plot.addEventListener("dblclick", () => this.whole());
  }

  _read(spec) {
    const track = (one) => ({ ...one, t: numbers(one.t), n: numbers(one.n), e: numbers(one.e) });
    this.truths = spec.truths.map(track);
    this.fixes = spec.fixes.map(track);
    this.tracks = spec.tracks.map((one) => ({
      ...track(one), error: one.error.map(numbers), covariance: one.covariance.map(numbers),
    }));
  }

  /** Show newer contents of the same map; all of it, where all was shown. */
  grow(spec) {
    const { x_range: x, y_range: y } = this.figure;
    const all = this.all && [x.start, x.end, y.start, y.end].every((value, k) => value == this.all[k]);
    this._read(spec);
    for (const take of this.fresh) take();
    if (all && !this.follows) this.whole();
  }

  _denied() {
    const inside = (at) => PAGE.windows.some(([start, end]) => at >= start && at < end);
    const renderer = this.line(-2, () => {
      const { t, n, e } = this.truths[0];
      const cut = (values) => bridged(t, values).map((value, k) => (inside(t[k]) ? value : NaN));
      return { x: cut(e), y: cut(n) };
    }, { line_width: 11, line_cap: "round", line_color: "#DDDDDD" });
    this.themed.push(() => renderer.glyph.setv({ line_color: colours().denied }));
  }

  _fixes(k) {
    const source = this.growing(() => ({ x: this.fixes[k].e, y: this.fixes[k].n }));
    const style = { source, size: 3, line_color: null };
    const renderer = this.figure.scatter({ field: "x" }, { field: "y" }, style);
    this.themed.push(() => renderer.glyph.setv({ fill_color: colours().fix }));
  }

  _ends(own) {
    for (const [marker, find] of [["circle", "findIndex"], ["square", "findLastIndex"]]) {
      const source = this.growing(() => {
        const { n, e } = this.truths[own];
        const k = n[find]((north, at) => Number.isFinite(north) && Number.isFinite(e[at]));
        return k < 0 ? { x: [], y: [] } : { x: [e[k]], y: [n[k]] };
      });
      const renderer = this.figure.scatter({ field: "x" }, { field: "y" }, { source, size: 9, marker, line_color: null });
      this.themed.push(() => renderer.glyph.setv({ fill_color: colourOf(-1) }));
    }
  }

  _buttons() {
    const row = make("span", "buttons");
    const add = (sign, said, does) => {
      const button = make("button", "", sign);
      button.type = "button";
      button.title = said;
      button.setAttribute("aria-label", said);
      button.addEventListener("click", () => does(button));
      row.append(button);
    };
    add("−", "map: zoom out", () => this.scale(1.6));
    add("+", "map: zoom in", () => this.scale(1 / 1.6));
    add("whole", "map: the whole flight", () => this.whole());
    add("follow", "map: stay at the cursor", (button) => {
      this.follows = !this.follows;
      button.setAttribute("aria-pressed", this.follows);
      if (this.follows) this.near();
    });
    this.caption.append(row);
  }

  scale(factor) {
    const { x_range: x, y_range: y } = this.figure;
    const at = this.follows && this.centre ? this.centre : { x: (x.start + x.end) / 2, y: (y.start + y.end) / 2 };
    this.fit(at.x, at.y, (factor * (x.end - x.start)) / 2, (factor * (y.end - y.start)) / 2);
  }

  /** All of truth and of the estimates that stay near it; of all estimates where there is no truth. */
  whole() {
    const far = ASTRAY * Math.max(extent(this.truths).side, LEAST_SIDE);
    const near = this.tracks.filter((one) => extent([...this.truths, one]).side <= far);
    const known = Number.isFinite(extent(this.truths).side);
    const { west, east, south, north, side } = extent(known ? [...this.truths, ...near] : this.tracks);
    if (west > east) return;
    const half = Math.max(side, LEAST_SIDE) / 2;
    const narrow = (width) => Math.max(0.55 * width, 0.1 * half, 5);
    this.fit((west + east) / 2, (south + north) / 2, narrow(east - west), narrow(north - south));
    const { x_range: x, y_range: y } = this.figure;
    this.all = [x.start, x.end, y.start, y.end];
  }

  /** The cursor, with room for errors and ellipses. */
  near() {
    if (!this.centre) return;
    const { x_range: x } = this.figure;
    const half = Math.min((x.end - x.start) / 2, Math.max(3 * this.reach, 20));
    this.fit(this.centre.x, this.centre.y, half);
  }

  follow() {
    const points = [];
    for (const { t, n, e } of this.truths) {
      const k = nearest(t, seen.cursor);
      if (k >= 0 && Number.isFinite(n[k])) points.push({ x: e[k], y: n[k], colour: colourOf(-1) });
    }
    this.centre = points[0];
    this.reach = 0;
    const around = { x: [], y: [], colour: [] };
    for (const { of, t, n, e, error, covariance } of this.tracks) {
      const k = nearest(t, seen.cursor);
      if (seen.hidden.has(of) || k < 0 || !Number.isFinite(n[k])) continue;
      points.push({ x: e[k], y: n[k], colour: colourOf(of) });
      this.centre ??= points[0];
      const claimed = ellipse(covariance.map((own) => own[k]), e[k], n[k], this.sigmas);
      if (!Number.isFinite(claimed.long)) continue;
      this.reach = Math.max(this.reach, claimed.long, Math.hypot(error[0][k], error[1][k]) || 0);
      around.x.push(claimed.x);
      around.y.push(claimed.y);
      around.colour.push(colourOf(of));
    }
    this.around.data = around;
    markersAt(this.here, points);
    if (this.follows) this.near();
  }

  _point(event) {
    const { left, top, width, height } = this.view.frame.bbox;
    const box = this.plot.getBoundingClientRect();
    const [px, py] = [event.clientX - box.left - left, event.clientY - box.top - top];
    if (px < 0 || py < 0 || px > width || py > height) return hideTip();
    const { x_range: x, y_range: y } = this.figure;
    const metres = (x.end - x.start) / width;
    const [east, north] = [x.start + px * metres, y.end - (py / height) * (y.end - y.start)];
    let [best, when] = [NEAREST * metres, null];
    for (const { t, n, e } of this.truths.length ? this.truths : this.tracks)
      for (let k = 0; k < t.length; k++) {
        const away = Math.hypot(e[k] - east, n[k] - north);
        // Where a track is met more than once, the time nearest to the cursor.
        const later = when !== null && Math.abs(t[k] - seen.cursor) >= Math.abs(when - seen.cursor);
        if (away < best - 2 * metres || (away < best + 2 * metres && !later)) [best, when] = [Math.min(away, best), t[k]];
      }
    if (when === null) return hideTip();
    setCursor(when);
    showTip(event, [
      [null, timeText(when), ""],
      [null, "east", `${text(east)} m`],
      [null, "north", `${text(north)} m`],
    ]);
  }
}

class Errors extends Plane {
  constructor(place, chart) {
    super(place, "Horizontal errors at the cursor, 95 % ellipses", "east [m]", "north [m]");
    this.chart = chart;
    this.guides();
    this.around = this.source({ x: [], y: [], colour: [] });
    const outlines = { source: this.around, line_color: { field: "colour" }, fill_color: { field: "colour" } };
    this.figure.patches({ field: "x" }, { field: "y" }, { ...outlines, fill_alpha: 0.1, line_width: 1.8 });
    this.here = this.source();
    const style = { source: this.here, size: 10, marker: "x", line_color: { field: "colour" }, line_width: 2.5 };
    this.figure.scatter({ field: "x" }, { field: "y" }, style);
  }

  follow() {
    const [points, sizes] = [[], []];
    const around = { x: [], y: [], colour: [] };
    this.told.replaceChildren();
    for (const { of, t, error, covariance } of this.chart.tracks) {
      if (seen.hidden.has(of)) continue;
      const k = nearest(t, seen.cursor);
      const [n, e] = k < 0 ? [NaN, NaN] : [error[0][k], error[1][k]];
      const claimed = ellipse(covariance.map((own) => own[Math.max(k, 0)]), 0, 0, this.chart.sigmas);
      const known = k >= 0 && Number.isFinite(claimed.long);
      if (known) {
        around.x.push(claimed.x);
        around.y.push(claimed.y);
        around.colour.push(colourOf(of));
      }
      if (Number.isFinite(n)) points.push({ x: e, y: n, colour: colourOf(of) });
      sizes.push(Math.max(known ? claimed.long : 0, Math.hypot(n, e) || 0));
      const size = known ? `; ${text(claimed.long)} × ${text(claimed.short)} m` : "";
      const one = make("span", "", `${text(Math.hypot(n, e))} m${size}`);
      one.title = PAGE.subjects[of].name;
      one.style.setProperty("--own", colourOf(of));
      this.told.append(one);
    }
    this.around.data = around;
    markersAt(this.here, points);
    const sound = sizes.filter((size) => size > 0);
    const least = Math.min(...sound);
    this.fit(0, 0, 1.15 * Math.max(...sound.filter((size) => size <= FAR * least), 0.1));
  }
}
