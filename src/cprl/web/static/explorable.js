// The page of five steps: a field of apples, who holds back, a rule, break it, what learners find.
// A trial is {scene, tables, policies, name}: what one setting of the sliders plays.

const EPISODES = 20;
/** The longest time that counting may keep the page busy at once, in milliseconds. */
const SLICE_MS = 12;
const SLOWEST = 20;
const LONGEST_FILM_S = 12;

/** Counts the episodes of a trial, bit by bit; returns the apples, the turns and the deaths of each. */
function* counted(trial) {
  const episodes = [];
  for (let number = 0; number < EPISODES; number++) {
    const population = new Population(trial.policies, trial.tables, 0, number);
    const { world } = population;
    let apples = 0;
    world.begin();
    while (world.ended === PLAYING) {
      population.play();
      for (let i = 0; i < world.harvest.length; i++) apples += world.harvest[i];
      if (world.step % 20 === 0) yield episodes;
    }
    episodes.push({ apples, turns: world.step, isDead: world.ended === TERMINATED });
  }
  return episodes;
}

const meanOf = (episodes, name) => episodes.reduce((sum, episode) => sum + episode[name], 0) / episodes.length;
const rounded = (value) => number(Math.round(value));

/** A film of scripted agents, who play on as it runs. */
class PlayedFilm {
  constructor({ scene, tables, policies }) {
    this.scene = scene;
    this.rings = policies.map((policy) => policy === "sustainable");
    this.population = new Population(policies, tables, 0, 0);
    this.world = this.population.world;
    this.world.begin();
    this.harvested = policies.map(() => 0);
  }

  next() {
    this.population.play();
    this.world.harvest.forEach((apples, i) => { this.harvested[i] += apples; });
  }

  get turn() {
    return this.world.step;
  }

  get ended() {
    return this.world.ended;
  }

  get stockLeft() {
    return this.world.stockLeft;
  }

  /** Returns what `drawBoard` takes of the turn. */
  moment() {
    const { row, col, heading, onBoard, stock } = this.world;
    const cells = Array.from(row, (line, i) => line * this.scene.width + col[i]);
    const poses = Array.from(heading, (direction, i) => direction + IN_PLAY * onBoard[i]);
    return { stock, cells, poses, beams: [], labels: this.harvested, rings: this.rings };
  }
}

/** A film of an episode that was played before: a scene with its moments. */
class RecordedFilm {
  constructor(recorded) {
    this.scene = recorded;
    this.turn = 0;
  }

  next() {
    this.turn += 1;
  }

  get ended() {
    if (this.turn < this.scene.moments.length - 1) return PLAYING;
    return this.scene.isDead ? TERMINATED : TRUNCATED;
  }

  get harvested() {
    return this.scene.moments[this.turn].harvest;
  }

  get stockLeft() {
    return this.scene.moments[this.turn].stock;
  }

  moment() {
    return { ...momentOf(this.scene, this.scene.moments[this.turn].board), labels: this.harvested };
  }
}

/** The board with the first episode of a trial as a film, the end in words, and a dot for each trial. */
class Stage {
  constructor() {
    this.tries = [];
    this.marks = [];
    this.asked = 0;
    this.busyMs = 0;
    addEventListener("resize", () => this.draw());
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  /** Shows a trial; what an earlier one has not finished is dropped. */
  show(trial) {
    this.trial = trial;
    this.first = null;
    this.busyMs = 0;
    this.isCounted = false;
    this.run(new PlayedFilm(trial));
    this.count(counted(trial), this.asked);
  }

  /** Shows an episode that was played before; its means are among the marks. */
  showRecorded(recorded) {
    this.trial = null;
    this.first = { turns: recorded.moments.length - 1 };
    this.isCounted = true;
    this.run(new RecordedFilm(recorded));
    element("mean").textContent = `${recorded.name}: ${rounded(recorded.apples)} apples, `
      + `${rounded(recorded.turns)} turns on average in fresh worlds.`;
    this.drawTries();
  }

  /** Shows the film anew that is there. */
  again() {
    if (this.trial) this.show(this.trial);
    else if (this.film) this.run(new RecordedFilm(this.film.scene));
  }

  /** Says that the board is not that of the sliders, until the next trial. */
  wait(words) {
    this.asked += 1;
    this.trial = null;
    this.film = null;
    element("board").style.opacity = 0.3;
    element("answer").className = "";
    element("answer").textContent = words;
    element("mean").textContent = "";
  }

  run(film) {
    this.asked += 1;
    this.film = film;
    this.due = 0;
    element("board").style.opacity = 1;
    fitBoard(element("board"), film.scene.width, film.scene.height);
    element("mean").textContent = "";
    this.drawFilm();
    const isStill = matchMedia("(prefers-reduced-motion: reduce)").matches;
    if (isStill) this.playTo(Infinity);
    else requestAnimationFrame((now) => this.frame(now, now, this.asked));
  }

  frame(now, before, asked) {
    if (asked !== this.asked || this.film.ended !== PLAYING) return;
    const rate = Math.max(SLOWEST, (this.first?.turns ?? 0) / LONGEST_FILM_S);
    this.due += Math.min(0.1, (now - before) / 1000) * rate;
    this.playTo(this.due);
    requestAnimationFrame((next) => this.frame(next, now, asked));
  }

  /** Plays the film up to a turn. */
  playTo(turn) {
    while (this.film.ended === PLAYING && this.film.turn < Math.floor(turn)) this.film.next();
    this.drawFilm();
  }

  drawFilm() {
    drawBoard(element("board"), this.film.scene, this.film.moment());
    this.sayTurn(this.film);
  }

  sayTurn({ turn, ended, stockLeft, harvested }) {
    const apples = number(harvested.reduce((sum, one) => sum + one, 0));
    const answer = element("answer");
    answer.className = { [TERMINATED]: "dead", [TRUNCATED]: "alive" }[ended] ?? "";
    answer.textContent = {
      [PLAYING]: `Turn ${number(turn)}: ${number(stockLeft)} apples on the field, ${apples} picked.`,
      [TERMINATED]: `Gone for good at turn ${number(turn)}: ${apples} apples, and none left to grow from.`,
      [TRUNCATED]: `Still alive after ${number(turn)} turns: ${apples} apples.`,
    }[ended];
  }

  /** Counts for a moment, and goes on in a later one. */
  count(counting, asked) {
    if (asked !== this.asked) return;
    const began = performance.now();
    let state = counting.next();
    while (!state.done && performance.now() - began < SLICE_MS) state = counting.next();
    this.busyMs += performance.now() - began;
    this.first = state.value[0] ?? null;
    if (state.done) this.keep(state.value);
    else setTimeout(() => this.count(counting, asked));
  }

  /** Keeps a trial as a dot, and says its mean. */
  keep(episodes) {
    const { name } = this.trial;
    const before = this.tries.at(-1);
    const found = { name, apples: meanOf(episodes, "apples"), turns: meanOf(episodes, "turns") };
    const deaths = episodes.filter((episode) => episode.isDead).length;
    found.isDead = deaths > 0;
    this.tries = [...this.tries.filter((other) => other.name !== name), found];
    const earlier = before && before.name !== name
      ? ` Before (${before.name}): ${rounded(before.apples)} apples, ${rounded(before.turns)} turns.` : "";
    element("mean").textContent = `${EPISODES} episodes: ${rounded(found.apples)} apples, `
      + `${rounded(found.turns)} turns on average; ${deaths} fields died.${earlier}`;
    this.isCounted = true;
    this.drawTries();
  }

  /** Adds marks, which stay in the plot. */
  mark(...marks) {
    const names = new Set(marks.map((mark) => mark.name));
    this.marks = [...this.marks.filter((mark) => !names.has(mark.name)), ...marks];
  }

  draw() {
    if (this.film) this.drawFilm();
    this.drawTries();
  }

  drawTries() {
    const list = element("list");
    list.replaceChildren();
    for (const found of [...this.marks, ...this.tries]) {
      made("li", list, `${found.name}: ${rounded(found.apples)} apples, ${rounded(found.turns)} turns`);
    }
    new TryPlot(element("tries"), [...this.marks, ...this.tries]).draw(this.tries.at(-1), new Set(this.marks));
  }
}

/** Apples against turns: a dot for each try, a diamond for each mark. */
class TryPlot {
  constructor(canvas, tries) {
    [this.pen, this.wide, this.high] = penOf(canvas);
    this.tries = tries;
    this.mostTurns = Math.max(1000, ...tries.map((found) => found.turns));
    this.step = [100, 200, 250, 500, 1000, 2000, 5000, 10000].find((step) => 5 * step >= this.mostApples()) ?? 20000;
    this.top = this.step * Math.max(1, Math.ceil(this.mostApples() / this.step));
    this.taken = [];
    const style = getComputedStyle(document.body);
    this.colour = (name) => style.getPropertyValue(`--${name}`);
  }

  mostApples() {
    return Math.max(500, ...this.tries.map((found) => found.apples));
  }

  x(turns) {
    return 46 + (this.wide - 62) * turns / this.mostTurns;
  }

  y(apples) {
    return this.high - 44 - (this.high - 74) * apples / this.top;
  }

  draw(now, marks) {
    this.axes();
    const order = [...this.tries].sort((one, other) => (other === now) - (one === now));
    for (const found of [...order].reverse()) this.dot(found, found === now, marks.has(found));
    this.taken = this.tries.map((found) => this.around(found));
    for (const found of order) this.name(found, found === now, marks.has(found));
  }

  axes() {
    const { pen } = this;
    pen.strokeStyle = this.colour("line");
    pen.fillStyle = this.colour("faint");
    pen.font = "13px system-ui, sans-serif";
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    for (let apples = 0; apples <= this.top; apples += this.step) {
      this.line(this.x(0), this.y(apples), this.x(this.mostTurns), this.y(apples));
      pen.fillText(number(apples), this.x(0) - 6, this.y(apples));
    }
    pen.textAlign = "center";
    for (const share of [0, 0.5, 1]) {
      const turns = share * this.mostTurns;
      pen.textAlign = share === 1 ? "right" : "center";
      pen.fillText(number(turns), this.x(turns) + (share === 1 ? 8 : 0), this.y(0) + 14);
    }
    pen.textAlign = "center";
    pen.fillText("turns that the field lasts", (this.x(0) + this.x(this.mostTurns)) / 2, this.high - 10);
    pen.textAlign = "left";
    pen.fillText("apples of all agents", 4, 12);
  }

  /** Returns the place of a dot, which names leave free. */
  around({ turns, apples }) {
    return { left: this.x(turns) - 7, right: this.x(turns) + 7, top: this.y(apples) - 8 };
  }

  line(left, top, right, bottom) {
    this.pen.beginPath();
    this.pen.moveTo(left, top);
    this.pen.lineTo(right, bottom);
    this.pen.stroke();
  }

  dot(found, isNow, isMark) {
    const { pen } = this;
    const size = isNow ? 8 : 5.5;
    pen.fillStyle = this.colour(found.isDead ? "dead" : "green");
    pen.globalAlpha = isNow || isMark ? 1 : 0.5;
    pen.beginPath();
    if (isMark) {
      for (const [right, down] of [[0, -8], [8, 0], [0, 8], [-8, 0]]) {
        pen.lineTo(this.x(found.turns) + right, this.y(found.apples) + down);
      }
    } else pen.arc(this.x(found.turns), this.y(found.apples), size, 0, 7);
    pen.fill();
    pen.globalAlpha = 1;
  }

  /** Names a dot where there is room for it. */
  name(found, isNow, isMark) {
    const { pen } = this;
    const text = `${found.name}: ${rounded(found.apples)}`;
    pen.font = `${isNow ? 700 : 400} 13px system-ui, sans-serif`;
    const wide = pen.measureText(text).width;
    const isRight = this.x(found.turns) + 12 + wide > this.wide;
    const beside = isRight ? this.x(found.turns) - 12 - wide : this.x(found.turns) + 12;
    const isAbove = beside < this.x(0) && (isNow || isMark);
    const middle = Math.min(this.x(found.turns) - wide / 2, this.wide - wide - 4);
    const left = isAbove ? Math.max(this.x(0), middle) : beside;
    const top = this.y(found.apples) - (isAbove ? 26 : 8);
    const isTaken = this.taken.some((box) => box.left < left + wide && left < box.right && Math.abs(box.top - top) < 15);
    if (left < this.x(0) || (isTaken && !isNow)) return;
    this.taken.push({ left, right: left + wide, top });
    pen.fillStyle = this.colour(isNow ? "text" : "faint");
    pen.textAlign = "left";
    pen.textBaseline = "middle";
    pen.fillText(text, left, top + 8);
  }
}

const data = JSON.parse(element("data").textContent);
const stage = new Stage();
const settings = { hold: 0, quota: 0, growth: data.growths.findIndex((growth) => growth.times === 1) };
const SLIDERS = {
  hold: { words: "agents that hold back", most: data.game.starts.length, value: (hold) => number(hold) },
  quota: {
    words: `apples that each may pick in ${data.window_steps} turns`,
    most: 20,
    value: (quota) => (quota ? number(quota) : "none"),
  },
  growth: {
    words: "growth of apples, times as fast",
    most: data.growths.length - 1,
    value: (index) => String(data.growths[index].times),
  },
};
const [NO_RULE, QUOTA] = data.learners;
const STEPS = [
  {
    short: "The field",
    title: "A field of apples",
    idea: "Four agents walk to the nearest apple and pick it. An apple grows back only where others stand near: "
      + "the more of them, the sooner. Where none is left, none grows.",
    sliders: [],
  },
  {
    short: "Who holds back",
    title: "What if some hold back?",
    idea: "An agent with a white frame picks an apple only where three others stand near it. How many of the four "
      + "must hold back?",
    sliders: ["hold"],
  },
  {
    short: "A rule",
    title: "And if there were a rule?",
    idea: "Nobody has to be nice: each may pick only so many apples in fifty turns, and then must wait. How many "
      + "are too many? How many too few?",
    sliders: ["quota", "hold"],
    begin: { hold: 0, quota: 12 },
  },
  {
    short: "Break it",
    title: "Now break it",
    idea: "Let apples grow slower or faster. When does no rule help, and when is none needed?",
    sliders: ["growth", "quota", "hold"],
  },
  {
    short: "What learners find",
    title: "Do agents who learn find out by themselves?",
    idea: `Without a rule they do not. Agents trained by trial and error get ${NO_RULE.income} apples in fresh worlds, `
      + `and ${NO_RULE.learning} while they learn; random play gets ${data.random}. Under a quota, the limit of six `
      + `above, they get ${QUOTA.income}. Diamonds are these trainings; brackets, 95% intervals over eight of them.`,
    sliders: ["quota", "hold", "growth"],
    marks: true,
  },
];
let step = -1;

/** Returns the trial of the sliders of the five steps. */
function trialOf({ hold, quota, growth }) {
  const { times, regrow_below, unit } = data.growths[growth];
  const limit = { share: quota / unit, unit, window_steps: data.window_steps, by_stock: false };
  const game = { ...data.game, regrow_below, quota: quota ? limit : null };
  const agents = game.starts.map((_, i) => (i < hold ? "sustainable" : "greedy"));
  const parts = [hold ? `${hold} hold back` : `${agents.length} greedy`];
  if (quota) parts.push(`limit ${quota}`);
  if (times !== 1) parts.push(`growth x ${times}`);
  return { scene: data.scene, tables: tablesOf(game), policies: agents, name: parts.join(", ") };
}

/** Adds a slider that changes one of the settings. */
function addSlider(name) {
  const { words, most, value } = SLIDERS[name];
  const label = made("label", element("controls"), `${words} `);
  const shown = made("span", label, value(settings[name]));
  const input = made("input", label);
  Object.assign(input, { type: "range", name, min: 0, max: most, step: 1 });
  input.value = settings[name];
  input.addEventListener("input", () => {
    settings[name] = Number(input.value);
    shown.textContent = value(settings[name]);
    stage.show(trialOf(settings));
  });
}

/** Opens a step. */
function openStep(index) {
  step = index;
  const { title, idea, sliders, begin, marks, show } = STEPS[index];
  Object.assign(settings, begin);
  element("title").textContent = title;
  element("idea").textContent = idea;
  element("controls").replaceChildren();
  element("next").hidden = index === STEPS.length - 1;
  if (marks) stage.mark(...data.learners.map(markOf));
  [...element("steps").children].forEach((button, at) => {
    if (at === index) button.setAttribute("aria-current", "step");
    else button.removeAttribute("aria-current");
  });
  sliders.forEach(addSlider);
  const section = element("own");
  if (section) section.hidden = !show;
  if (show) show();
  else stage.show(trialOf(settings));
}

/** Returns the diamond of trained agents. */
function markOf({ name, income, turns }) {
  return { name, apples: parseFloat(income), turns, isDead: turns < data.game.episode_steps };
}

/** Adds the button of a step. */
function addStep({ short }, index) {
  const button = made("button", element("steps"), String(index + 1));
  made("span", button, ` ${short}`);
  button.setAttribute("aria-label", `${index + 1} ${short}`);
  button.addEventListener("click", () => openStep(index));
}

STEPS.forEach(addStep);
element("next").addEventListener("click", () => openStep(step + 1));
element("again").addEventListener("click", () => stage.again());
if (!element("own")) openStep(0);
