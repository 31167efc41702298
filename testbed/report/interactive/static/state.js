// What is seen of the page, in one place: the stretch of time, the cursor, who is hidden. Whoever shows it listens.

let NUMBERS;
function read(base64) {
  const letters = atob(base64);
  const bytes = new Uint8Array(letters.length);
  for (let k = 0; k < bytes.length; k++) bytes[k] = letters.charCodeAt(k);
  NUMBERS = new Float32Array(bytes.buffer);
}
read(PAGE.numbers);
const numbers = ([start, count]) => NUMBERS.subarray(start, start + count);

const seen = {
  start: PAGE.start,
  end: PAGE.end,
  cursor: PAGE.start,
  hidden: new Set(),
  bands: true,
  pans: false, // what dragging does: move, or zoom
};
const shortest = () => Math.min(1, (PAGE.end - PAGE.start) / 4); // stretch of time [s]
const FAR = 16; // times: who is off by so much more than the best is cut off, and named
const NEAREST = 30; // pixels from a track that the cursor follows

const listeners = { stretch: [], cursor: [], shown: [], theme: [], grown: [] };
const listen = (topic, does) => listeners[topic].push(does);
const due = new Set();
function tell(topic) {
  if (!due.size) requestAnimationFrame(() => {
    const topics = [...due];
    due.clear();
    for (const one of topics) for (const does of listeners[one]) does();
  });
  due.add(topic);
}

function setCursor(t) {
  seen.cursor = Math.min(Math.max(t, PAGE.start), PAGE.end);
  tell("cursor");
}

function setStretch(start, end) {
  const whole = PAGE.end - PAGE.start;
  const width = Math.min(Math.max(end - start, shortest()), whole);
  const middle = (start + end) / 2;
  const from = Math.min(Math.max(middle - width / 2, PAGE.start), PAGE.end - width);
  if (Math.abs(from - seen.start) < 1e-9 * whole && Math.abs(from + width - seen.end) < 1e-9 * whole) return;
  [seen.start, seen.end] = [from, from + width];
  tell("stretch");
  tell("cursor");
}

function zoom(factor, about = seen.cursor) {
  const held = Math.min(Math.max(about, seen.start), seen.end);
  setStretch(held - (held - seen.start) * factor, held + (seen.end - held) * factor);
}

function jump(t) {
  setCursor(t);
  const half = Math.min(30, (seen.end - seen.start) / 2);
  setStretch(t - half, t + half);
}

function toggle(subject) {
  if (!seen.hidden.delete(subject)) seen.hidden.add(subject);
  tell("shown");
}

// --- numbers and text

/** The first index whose time is not before t. */
function after(times, t) {
  let [low, high] = [0, times.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] < t) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** The index of the time nearest to t, -1 where there is none about it. */
function nearest(times, t) {
  if (!times.length) return -1;
  const k = after(times, t);
  const at = k > 0 && (k == times.length || t - times[k - 1] < times[k] - t) ? k - 1 : k;
  const step = times.length > 1 ? (times[times.length - 1] - times[0]) / (times.length - 1) : 1;
  return Math.abs(times[at] - t) <= Math.max(3 * step, 0.2) ? at : -1;
}

function text(value) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size >= 1e6 || (size > 0 && size < 1e-4)) return value.toExponential(2).replace("-", "−");
  const digits = size >= 1000 ? 0 : size >= 100 ? 1 : size >= 10 ? 2 : size >= 1 ? 3 : 4;
  return value.toFixed(digits).replace("-", "−");
}

function timeText(t) {
  const minutes = Math.floor(t / 60);
  const said = `${t.toFixed(1)} s`;
  return minutes ? `${said} (${minutes}:${String(Math.floor(t - 60 * minutes)).padStart(2, "0")})` : said;
}

function make(tag, name = "", content = "") {
  const element = document.createElement(tag);
  if (name) element.className = name;
  if (content !== "") element.textContent = content;
  return element;
}

// --- colours

const DASHES = ["solid", [7, 4], [2, 3], [7, 3, 2, 3]];
const prefersDark = matchMedia("(prefers-color-scheme: dark)");
let onPaper = false;
const dark = () => prefersDark.matches && !onPaper;
const colourOf = (of) => (of < 0 ? (dark() ? "#F4F4F4" : "#000000") : PAGE.subjects[of][dark() ? "dark" : "light"]);
const LIGHT = {
  ground: "#FFFFFF", text: "#333333", grid: "#E4E4E4", guide: "#555555", denied: "#DDDDDD", fault: "#FBE9A8",
  good: "#DCE8DC", fix: "#777777",
};
const DARK = {
  ground: "#16191D", text: "#D5D8DC", grid: "#2B3036", guide: "#9AA3AD", denied: "#343A42", fault: "#57491A",
  good: "#1F3A2C", fix: "#8A929C",
};
const colours = () => (dark() ? DARK : LIGHT);
prefersDark.addEventListener("change", () => tell("theme"));

function dress(figure) {
  const own = colours();
  figure.setv({ background_fill_color: own.ground, border_fill_color: own.ground, outline_line_color: own.grid });
  for (const axis of figure.axes) {
    axis.setv({
      axis_label_text_color: own.text, major_label_text_color: own.text, axis_line_color: own.guide,
      major_tick_line_color: own.guide, minor_tick_line_color: null, axis_label_text_font_style: "normal",
      axis_label_text_font_size: "12px", major_label_text_font_size: "11px",
    });
  }
  for (const grid of figure.grids) grid.setv({ grid_line_color: own.grid });
}
