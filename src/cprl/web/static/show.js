class Population {
  constructor(own, parent) {
    Object.assign(this, own);
    this.last = this.moments.length - 1;
    const card = made("article", parent, "", "population");
    const head = made("h2", card, `${this.title} `);
    this.end = made("span", head, "", this.isDead ? "end dead" : "end");
    if (this.which) made("p", card, this.which, "faint");
    const ratio = this.width / this.height;
    this.board = madeCanvas(card, `the board of ${this.title}`);
    fitBoard(this.board, this.width, this.height);
    this.board.style.maxWidth = `calc(${ratio} * 34vh)`;
    const numbers = made("ul", card, "", "numbers");
    this.numbers = this.counted.map((words) => {
      const item = made("li", numbers);
      const value = made("b", item);
      made("span", item, words);
      return value;
    });
    this.course = madeCanvas(card, `apples on the board and picked by each agent over the turns, ${this.title}`);
    this.course.className = "course";
    this.course.addEventListener("pointerdown", (event) => {
      const place = (event.clientX - this.course.getBoundingClientRect().left) / this.course.clientWidth;
      go(Math.round(place * this.axis));
    });
    const agents = made("ul", card, "", "agents");
    this.items = this.colours.map((colour, agent) => {
      const item = made("li", agents);
      made("i", item, agent).style.background = rgb(colour);
      return {item, apples: made("span", item)};
    });
    made("p", card, this.about, "faint");
  }

  draw(clock) {
    const turn = Math.min(clock, this.last);
    this.end.textContent = clock >= this.last ? this.outcome : "";
    const {harvest: got, stock, board} = this.moments[turn];
    const fined = this.fined ? [this.fined[this.last] ? this.fined[turn].toFixed(1) : "none"] : [];
    const equal = this.equality[turn];
    const values = [`${number(stock)} / ${number(this.sites.length)}`, number(got.reduce((all, one) => all + one, 0)),
      equal === null ? "–" : equal.toFixed(2), ...fined];
    this.numbers.forEach((value, place) => { value.textContent = values[place]; });
    this.items.forEach(({item, apples}, agent) => {
      apples.textContent = number(got[agent]);
      item.className = board.poses[agent] & IN_PLAY ? "" : "out";
    });
    drawBoard(this.board, this, momentOf(this, board));
    this.drawCourse(turn);
  }

  /** Two plots over the turns, one above the other: the apples on the board, and what each agent picked. */
  drawCourse(turn) {
    const [pen, wide, high] = penOf(this.course), line = 15, deep = (high - 3 * line) / 2 - 2;
    const x = (at) => at / this.axis * wide;
    const plot = (top, most, words) => {
      pen.fillStyle = "#a0a7b4";
      pen.fillText(`${words}, 0 to ${number(most)}`, 4, top + 11);
      return (value) => top + line + deep * (1 - value / Math.max(1, most));
    };
    pen.font = "13px system-ui, sans-serif";
    pen.textAlign = "left";
    const stock = plot(0, this.sites.length, "apples on the board");
    pen.fillStyle = rgb(this.palette.apple);
    pen.beginPath();
    pen.moveTo(0, stock(0));
    for (let at = 0; at <= turn; at++) pen.lineTo(x(at), stock(this.moments[at].stock));
    pen.lineTo(x(turn), stock(0));
    pen.fill();
    const picked = plot(line + deep + 2, this.most, "picked by each agent");
    pen.lineWidth = 2;
    for (let agent = 0; agent < this.lines.length; agent++) {
      pen.strokeStyle = rgb(this.lines[agent]);
      pen.beginPath();
      for (let at = 0; at <= turn; at++) {
        pen[at ? "lineTo" : "moveTo"](x(at), picked(this.moments[at].harvest[agent]));
      }
      pen.stroke();
    }
    pen.fillStyle = "#a0a7b4";
    pen.fillText("turn 0", 4, high - 3);
    pen.textAlign = "right";
    pen.fillText(number(this.axis), wide - 4, high - 3);
    pen.fillStyle = "#e8eaee";
    pen.fillRect(x(turn) - .5, 0, 1, high - line);
  }
}

const slider = element("turn"), button = element("play");
let populations = [], now = 0, length = 0, isPlaying = false, before = 0, due = 0;

function go(turn) {
  now = Math.max(0, Math.min(length, turn));
  slider.value = now;
  element("now").textContent = `turn ${number(now)}`;
  slider.setAttribute("aria-valuetext", `turn ${now} of ${length}`);
  populations.forEach((population) => population.draw(now));
  if (now === length) play(false);
}

function play(start) {
  if (start && now === length) go(0);
  if (start && !isPlaying) { before = performance.now(); due = 0; requestAnimationFrame(tick); }
  isPlaying = start;
  button.textContent = start ? "Pause" : "Play";
}

function tick(time) {
  if (!isPlaying) return;
  due += Math.min(.25, Math.max(0, time - before) / 1000) * element("speed").value;
  before = time;
  const turns = Math.floor(due);
  due -= turns;
  if (turns) go(now + turns);
  requestAnimationFrame(tick);
}

addEventListener("keydown", (event) => {
  const isControl = /^(INPUT|SELECT|BUTTON)$/.test(event.target.tagName) && event.target !== slider;
  if (isControl || event.ctrlKey || event.metaKey || event.altKey) return;
  const step = event.shiftKey ? 10 : 1;
  const does = {" ": () => play(!isPlaying), ArrowLeft: () => go(now - step), ArrowRight: () => go(now + step),
    Home: () => go(0), End: () => go(length)}[event.key];
  if (does) { event.preventDefault(); does(); }
});
button.addEventListener("click", () => { play(!isPlaying); button.blur(); });
slider.addEventListener("input", () => { play(false); go(Number(slider.value)); });
addEventListener("resize", () => go(now));

/** Shows the populations of some data instead of those that are there. */
async function load({populations: own, axis, most, legend}) {
  await Promise.all(own.map(unpack));
  play(false);
  element("populations").replaceChildren();
  populations = own.map((one) => new Population({...one, axis, most}, element("populations")));
  element("legend").textContent = legend;
  length = Math.max(...populations.map((population) => population.last));
  slider.max = length;
}

(async () => {
  const data = JSON.parse(element("data").textContent);
  if (!data.populations.length) { slider.closest("section").hidden = true; return; }
  await load(data);
  const asked = /^#turn=(\d+)$/.exec(location.hash);
  go(asked ? Number(asked[1]) : 0);
  if (!asked && !matchMedia("(prefers-reduced-motion: reduce)").matches) play(true);
  document.body.dataset.ready = "yes";
})();
