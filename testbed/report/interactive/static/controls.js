// The bar that stays in sight: who is shown, where the cursor is, what happened; keys; paper; and the start of it all.

const REST_MS = 300; // between panels that nobody waits for
const bar = document.getElementById("bar");
const panels = [];
const planes = [];

function button(sign, said, does, pressed) {
  const made = make("button", "", sign);
  made.type = "button";
  made.title = said;
  made.setAttribute("aria-label", said);
  if (pressed !== undefined) made.setAttribute("aria-pressed", pressed);
  made.addEventListener("click", () => does(made));
  return made;
}

function key(kind, said) {
  const made = make("span", "key", said);
  made.prepend(make("i", kind));
  return made;
}

// --- legend

function legend() {
  const row = make("div", "legend");
  row.setAttribute("role", "group");
  row.setAttribute("aria-label", "Shown");
  const chips = PAGE.subjects.map((subject, of) => {
    const chip = button("", `show or hide ${subject.name} (key ${of + 1})`, () => toggle(of), true);
    chip.append(make("i", `dash${subject.dash}`), subject.name);
    row.append(chip);
    return chip;
  });
  const paint = () => chips.forEach((chip, of) => {
    chip.style.setProperty("--own", colourOf(of));
    chip.setAttribute("aria-pressed", !seen.hidden.has(of));
  });
  listen("shown", paint);
  listen("theme", paint);
  paint();
  if (PAGE.band) {
    const bands = button(PAGE.band, "show or hide bands (key b)", () => {
      seen.bands = !seen.bands;
      tell("shown");
    }, true);
    listen("shown", () => bands.setAttribute("aria-pressed", seen.bands));
    row.append(bands);
  }
  if (PAGE.reference) row.append(key("truth", PAGE.reference));
  if (PAGE.windows.length || PAGE.live) row.append(key("denied", "no GNSS fix"));
  if (PAGE.faults.length || PAGE.live) row.append(key("fault", "fault of a sensor"));
  return row;
}

// --- time

/** What happened, in its order: events, faults and where there is no fix. */
const marks = () => [
  ...PAGE.events.map(({ t, severity, text: said }) => ({ t, severity, said })),
  ...PAGE.faults.map(({ start, text: said }) => ({ t: start, severity: "fault", said })),
  ...PAGE.windows.map(([start]) => ({ t: start, severity: "denied", said: "no GNSS fix from here" })),
].filter(({ t }) => t >= PAGE.start && t <= PAGE.end).sort((a, b) => a.t - b.t);

function step(way) {
  const later = ({ t }) => t > seen.cursor + 0.05;
  const ahead = way > 0 ? marks().find(later) : marks().findLast(({ t }) => t < seen.cursor - 0.05);
  if (ahead) jump(ahead.t);
}

function timeline() {
  const share = (t) => `${(100 * (t - PAGE.start)) / (PAGE.end - PAGE.start)}%`;
  const strip = make("div", "strip");
  const stretch = make("div", "stretch");
  const between = (one, start, end) => {
    one.style.left = share(start);
    one.style.width = `calc(${share(end)} - ${share(start)})`;
  };
  const slider = make("input", "slider");
  Object.assign(slider, { type: "range", step: "any" });
  const showMarks = () => {
    Object.assign(slider, { min: PAGE.start, max: PAGE.end });
    const stripes = [...PAGE.windows.map(([start, end]) => [start, end, "denied", "no GNSS fix"]),
      ...PAGE.faults.map(({ start, end, text: said }) => [start, end, "fault", said])];
    strip.replaceChildren(stretch, ...stripes.map(([start, end, what, said]) => {
      const stripe = make("div", what);
      between(stripe, start, end);
      stripe.title = said;
      return stripe;
    }), ...marks().map(({ t, severity, said }) => {
      const mark = button("", `${timeText(t)}: ${said}`, () => jump(t));
      mark.className = `mark ${severity}`;
      mark.style.left = share(t);
      mark.tabIndex = -1; // keys n and p lead to each, and so does the table
      return mark;
    }));
  };
  slider.setAttribute("aria-label", "Time");
  slider.addEventListener("input", () => setCursor(Number(slider.value)));
  const showCursor = () => {
    slider.value = seen.cursor;
    slider.setAttribute("aria-valuetext", timeText(seen.cursor));
  };
  const showStretch = () => between(stretch, seen.start, seen.end);
  listen("cursor", showCursor);
  listen("stretch", showStretch);
  listen("grown", showMarks);
  showMarks();
  showCursor();
  showStretch();
  const whole = make("div", "time");
  whole.append(strip, slider);
  return whole;
}

function buttons() {
  const row = make("div", "buttons");
  const now = make("output", "now", timeText(seen.cursor));
  listen("cursor", () => (now.textContent = timeText(seen.cursor)));
  row.append(now);
  if (marks().length || PAGE.live) row.append(
    button("◂ event", "the event before (key p)", () => step(-1)),
    button("event ▸", "the next event (key n)", () => step(1)),
  );
  row.append(
    button("−", "zoom out (key −)", () => zoom(2)),
    button("+", "zoom in (key +)", () => zoom(0.5)),
    button("whole", "the whole run (key 0, or a double click)", () => setStretch(PAGE.start, PAGE.end)),
  );
  if (!touches) row.append(
    button("drag moves", "what dragging does: move, or zoom (key d)", () => drags(), false),
  );
  row.append(button("?", "keys", () => document.getElementById("keys").showModal()));
  return row;
}

function drags() {
  seen.pans = !seen.pans;
  for (const choose of gestured) choose();
  for (const one of bar.querySelectorAll("button")) if (one.textContent == "drag moves") one.setAttribute("aria-pressed", seen.pans);
}

// --- keys

const KEYS = {
  ArrowLeft: (event) => setCursor(seen.cursor - ((seen.end - seen.start) * (event.shiftKey ? 10 : 1)) / 200),
  ArrowRight: (event) => setCursor(seen.cursor + ((seen.end - seen.start) * (event.shiftKey ? 10 : 1)) / 200),
  "+": () => zoom(0.5),
  "=": () => zoom(0.5),
  "-": () => zoom(2),
  "−": () => zoom(2),
  0: () => setStretch(PAGE.start, PAGE.end),
  n: () => step(1),
  p: () => step(-1),
  b: () => {
    seen.bands = !seen.bands;
    tell("shown");
  },
  d: () => drags(),
  "?": () => document.getElementById("keys").showModal(),
};

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
  const of = Number(event.key) - 1;
  const does = KEYS[event.key] ?? (PAGE.subjects[of] && (() => toggle(of)));
  if (!does) return;
  event.preventDefault();
  does(event);
});

// --- paper: pictures of the plots as they are, in light colours

const TURNS = 20; // of the queue of promises, after which Bokeh has heeded a change; paper waits for those
async function toPaper() {
  onPaper = true;
  const drawn = [...panels, ...planes].filter(({ view }) => view);
  for (const one of drawn) {
    one.inSight = true;
    if (one.update) one.update();
    one.theme();
    one.follow();
  }
  for (let turn = 0; turn < TURNS; turn++) await null;
  for (const one of drawn) {
    const picture = make("img", "paper");
    picture.src = one.view.export("png").canvas.toDataURL();
    picture.alt = one.plot.getAttribute("aria-label");
    one.plot.after(picture);
  }
}

function fromPaper() {
  onPaper = false;
  for (const picture of document.querySelectorAll("img.paper")) picture.remove();
  tell("theme");
}
addEventListener("beforeprint", toPaper);
addEventListener("afterprint", fromPaper);

// --- the start

function sight() {
  const looks = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      const panel = panels.find(({ element }) => element == target);
      panel.inSight = isIntersecting;
      if (!isIntersecting) continue;
      panel.build();
      if (panel.stale) panel.update();
      panel.follow();
    }
  }, { rootMargin: "200px" });
  for (const { element } of panels) looks.observe(element);
}

/** Make the panels that nobody has seen yet, one at a time: paper shows them all. */
function idle() {
  const next = panels.find(({ made }) => !made);
  const wait = window.requestIdleCallback ?? setTimeout;
  if (next) wait(() => next.build().then(() => setTimeout(idle, REST_MS)), { timeout: 2000 });
  else document.documentElement.dataset.state = "whole";
}

function resized() {
  for (const panel of panels) panel.follow();
  if (planes.length) {
    planes[0].whole();
    for (const plane of planes) plane.follow();
  }
}

/** What the colours of crosses mean, of those that there are. */
function crosses(own) {
  const row = make("div", "keys");
  const show = () => {
    const found = own.flatMap(({ dots }) => dots.flatMap(({ not_used }) => not_used.map(({ outcome }) => outcome)));
    row.replaceChildren(...[...new Set(found)].sort((a, b) => a - b).map((outcome) => {
      const made = key("cross", PAGE.outcomes[outcome].name);
      made.style.setProperty("--own", PAGE.outcomes[outcome][dark() ? "dark" : "light"]);
      return made;
    }));
  };
  listen("theme", show);
  listen("grown", show);
  show();
  return row;
}

async function start() {
  bar.append(legend(), timeline(), buttons());
  document.addEventListener("click", ({ target }) => {
    if (target.dataset?.t === undefined) return;
    jump(Number(target.dataset.t));
    bar.nextElementSibling.scrollIntoView();
  });
  PAGE.chapters.forEach((chapter, k) => {
    const place = document.getElementById(`chapter-${k}`);
    const own = chapter.panels.map((spec, at) => new Panel({ ...spec, last: at == chapter.panels.length - 1 }, place));
    place.prepend(crosses(own));
    panels.push(...own);
  });
  document.body.append(tip);
  if (PAGE.map) {
    const place = document.getElementById("map");
    const chart = new Chart(place, PAGE.map);
    planes.push(chart);
    if (PAGE.map.tracks.length) planes.push(new Errors(place, chart));
    for (const plane of planes) await plane.show();
    for (const plane of planes) new ResizeObserver(resized).observe(plane.plot);
  }
  listen("cursor", () => [...planes, ...panels].forEach((one) => one.follow()));
  listen("stretch", () => panels.forEach((panel) => panel.update()));
  listen("shown", () => {
    for (const panel of panels) panel.update(), panel.follow();
    for (const plane of planes) plane.shown(), plane.follow();
  });
  listen("theme", () => {
    for (const one of [...panels, ...planes]) one.theme(), one.follow();
  });
  new ResizeObserver(() => panels.forEach((panel) => panel.follow())).observe(document.body);
  sight();
  const outage = PAGE.windows.find(([begin]) => begin > PAGE.start); // before the first nobody is aligned
  setCursor(PAGE.live ? PAGE.end : outage ? outage[0] : (PAGE.start + PAGE.end) / 2);
  document.documentElement.dataset.state = "open";
  idle();
}

// What tests and the curious may look at.
window.page = { seen, panels, planes, setStretch, setCursor, toggle, jump };
const started = start();
