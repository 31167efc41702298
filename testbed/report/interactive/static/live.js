// A page of a run in progress: whoever serves it sends all contents anew, which take the place of those shown.

const said = document.getElementById("state");
const happened = document.getElementById("told");

/** What must be there before numbers can take each other's place. */
const layout = ({ subjects, chapters, map }) => JSON.stringify([
  subjects,
  chapters.map(({ title, panels: own }) => [title, own.map((panel) => panel.title)]),
  map && [map.truths.length, map.tracks.map(({ of }) => of), map.fixes.length],
]);

function showState() {
  const far = `${timeText(PAGE.end)} of ${text(PAGE.live.duration)} s`;
  said.textContent = PAGE.live.complete ? `The run is over: ${far}.` : `In progress: ${far}.`;
}

function showEvents() {
  happened.replaceChildren(...PAGE.events.map(({ t, severity, text: what }) => {
    const row = make("tr");
    const at = make("button", "at", `${t.toFixed(1)} s`);
    at.dataset.t = t;
    const first = make("td");
    first.append(at);
    row.append(first, make("td", "", severity), make("td", "", what));
    return row;
  }));
}

/** Who looks at the whole, or at the end, goes on looking at it. */
function take(fresh) {
  const [start, end] = [PAGE.start, PAGE.end];
  const whole = seen.start == start && seen.end == end;
  const atEnd = seen.end == end;
  const cursorAtEnd = seen.cursor == end;
  Object.assign(PAGE, fresh);
  read(PAGE.numbers);
  if (whole) [seen.start, seen.end] = [PAGE.start, PAGE.end];
  else if (atEnd && PAGE.end > end) [seen.start, seen.end] = [seen.start + PAGE.end - end, PAGE.end];
  if (cursorAtEnd || seen.cursor > PAGE.end) seen.cursor = PAGE.end;
  PAGE.chapters.flatMap((chapter) => chapter.panels).forEach((spec, k) => panels[k].grow({ ...panels[k].spec, ...spec }));
  if (PAGE.map) planes[0].grow(PAGE.map);
  showState();
  showEvents();
  for (const topic of ["grown", "stretch", "cursor"]) tell(topic);
}

// What was chosen outlives that the page is made anew.
const KEPT = "seen";
function keep() {
  const { start, end, cursor, hidden, bands } = seen;
  const stretch = start == PAGE.start && end == PAGE.end ? null : [start, end];
  const names = [...hidden].map((of) => PAGE.subjects[of].name);
  sessionStorage.setItem(KEPT, JSON.stringify({ stretch, cursor: cursor == PAGE.end ? null : cursor, names, bands }));
}

function again() {
  const kept = JSON.parse(sessionStorage.getItem(KEPT) ?? "null");
  sessionStorage.removeItem(KEPT);
  if (!kept) return;
  PAGE.subjects.forEach(({ name }, of) => kept.names.includes(name) && seen.hidden.add(of));
  seen.bands = kept.bands;
  if (kept.stretch) setStretch(...kept.stretch);
  if (kept.cursor !== null) setCursor(kept.cursor);
  tell("shown");
}

function listenOn() {
  const news = new EventSource(`events?${PAGE.live.version}`);
  news.onmessage = ({ data }) => {
    const fresh = JSON.parse(data);
    if (layout(fresh) == layout(PAGE)) return take(fresh);
    news.close();
    keep();
    location.reload();
  };
  news.onerror = () => (said.textContent = "Nobody serves this page any more: it stays as it is.");
  news.onopen = showState;
}

showState();
showEvents();
started.then(() => {
  again();
  listenOn();
});
