const SEAT = "cprl-seat", CHAT = "cprl-chat";
const MOST_LINES = 50;
/** What the keys do: the directions 0 to 3 are those of the screen, clockwise from up. */
const KEYS = {
  ArrowUp: 0, ArrowRight: 1, ArrowDown: 2, ArrowLeft: 3, w: 0, d: 1, s: 2, a: 3,
  q: "turn_left", e: "turn_right", f: "beam", " ": "harvest", c: "clean", x: "stay",
};
/** Actions that move, clockwise from where the agent heads. */
const MOVES = ["forward", "right", "backward", "left"];
/** The buttons of the pad, in four columns: what each does, its sign, its word. */
const BUTTONS = [
  ["turn_left", "↶", "turn"], [0, "↑", ""], ["turn_right", "↷", "turn"], ["beam", "✦", "beam"],
  [3, "←", ""], [2, "↓", ""], [1, "→", ""], ["harvest", "●", "harvest"], ["clean", "≈", "clean"], ["stay", "■", "stay"],
];
const SHORTEST_WAIT_MS = 250, LONGEST_WAIT_MS = 4000;
const state = {stage: {stage: "joining"}, held: [], number: 0, wait: SHORTEST_WAIT_MS, lines: []};
let socket = null;

const say = (words) => { element("said").textContent = words; };
const seconds = (count) => `${Math.floor(count / 60)}:${String(Math.floor(count % 60)).padStart(2, "0")}`;
const plural = (count, word) => `${number(count)} ${word}${count === 1 ? "" : "s"}`;

// The seat

/** Returns what this window keeps by a name, also when its page is loaded again. */
function keptOf(name, otherwise) {
  try { return JSON.parse(sessionStorage.getItem(name)) ?? otherwise; } catch { return otherwise; }
}

/** Takes a seat by the link, or asks for the one that this window has; opens the socket. */
async function join() {
  const kept = keptOf(SEAT, {}), token = location.hash.slice(1) || kept.token;
  if (!token) return stop("Open this page by the link, or the picture, that you were given.");
  const body = {token};
  if (kept.token === token) body.seat_token = kept.seat_token;
  let answer, news;
  try {
    answer = await fetch("join", {method: "POST", headers: {"Content-Type": "application/json"}, body: JSON.stringify(body)});
    news = await answer.json();
  } catch { return tryAgain("The connection is lost; trying again…"); }
  if (answer.status === 429 || answer.status >= 500) return tryAgain("The server is busy; trying again…");
  if (!answer.ok) return stop(`You cannot play here: ${news.why}.`);
  sessionStorage.setItem(SEAT, JSON.stringify({token, seat_token: news.seat_token}));
  if (kept.seat_token !== news.seat_token) sessionStorage.removeItem(CHAT);
  else if (!state.lines.length) keptOf(CHAT, []).forEach(([from, text]) => addLine(from, text));
  history.replaceState(null, "", location.pathname);
  open(news.seat_token);
}

/** Joins again, later and later. */
function tryAgain(words) {
  say(words);
  document.body.dataset.connection = "lost";
  setTimeout(join, state.wait * (.5 + Math.random()));
  state.wait = Math.min(LONGEST_WAIT_MS, 2 * state.wait);
}

/** Says why this window does not play. */
function stop(words) {
  say(words);
  document.body.dataset.connection = "refused";
  for (const name of ["reading", "view", "scores", "chat", "pad"]) element(name).hidden = true;
}

/** Opens the socket of a seat. */
function open(seatToken) {
  socket = new WebSocket(`${location.origin.replace(/^http/, "ws")}/socket`, ["cprl", seatToken]);
  socket.addEventListener("open", () => {
    state.wait = SHORTEST_WAIT_MS;
    document.body.dataset.connection = "open";
    say("");
  });
  socket.addEventListener("message", (event) => {
    const news = JSON.parse(event.data);
    RECEIVE[news.type]?.(news);
    if (news.type !== "chat" && news.type !== "error") show();
  });
  socket.addEventListener("close", (event) => {
    state.held = [];
    if (event.code === 4001) takeBack(event.reason);
    else if (event.code === 4008) stop("Too many messages came from this window. Load the page again to play on.");
    else tryAgain("The connection is lost; trying again…");
  });
}

/** Offers to play here instead of in the other window of the same seat. */
function takeBack(why) {
  stop(why ? `${why[0].toUpperCase()}${why.slice(1)}. ` : "This seat is open in another window. ");
  made("button", element("said"), "Play here").addEventListener("click", join);
}

/** Sends a message, if the socket is open. */
function send(type, fields = {}) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify({type, ...fields}));
}

// What the server says

const RECEIVE = {
  welcome(news) { state.me = news.agent; state.code = news.code; state.consent = news.consent; },
  stage(news) {
    state.stage = news;
    state.until = news.seconds === null ? null : performance.now() + 1000 * news.seconds;
  },
  round(news) {
    const isSame = state.round?.round === news.round && state.round.rule === news.rule;
    if (!isSame) state.before = state.ended;
    Object.assign(state, {round: news, turn: null, ended: null, names: news.names, chosen: null});
    if (!isSame) Object.assign(state, {isReady: false, vote: null});
    state.sight = {rows: news.observation_shape[1], columns: news.observation_shape[2], colours: news.window_colours};
    buildRound();
  },
  turn(news) { state.turn = news; state.chosen = null; playHeld(); },
  chat(news) { addLine(news.from, news.text); },
  vote(news) { state.result = [].concat(news.result).join("; "); },
  round_end(news) { state.ended = {...news, rule: news.round ? state.round.rule : "practice"}; },
  end(news) { state.end = news; state.names = news.names ?? state.names; },
  error(news) {
    if (state.ended) return;  // a key that came after the last turn
    say(news.why);
    setTimeout(() => { if (element("said").textContent === news.why) say(""); }, 4000);
  },
};

// Keys and buttons

/** Returns the name of the action that a key or a button means now; null for none of the game. */
function actionOf(command) {
  const actions = state.round.actions;
  if (typeof command !== "number") {
    const isBeam = command === "harvest" && !actions.includes("harvest");
    const name = isBeam ? "beam" : command;
    return actions.includes(name) ? name : null;
  }
  const heading = state.turn?.board ? state.turn.board.poses[state.me] & 3 : 0;
  return MOVES[(command - heading + 4) % 4];
}

/** Whether a round is on that this person plays. */
const isPlaying = () => ["practice", "playing"].includes(state.stage.stage) && state.round && !state.ended;

/** Sends what a key or a button means. */
function act(command) {
  const action = isPlaying() ? actionOf(command) : null;
  if (!action) return;
  send("action", {action, number: ++state.number});
  if (state.round.turns_a_second === null) {
    state.chosen = action;
    show();
  }
}

/** Plays the last key that is still held, where turns have a clock. */
function playHeld() {
  if (state.held.length && state.round.turns_a_second !== null) act(state.held.at(-1));
}

/** Notes that a key or a button is held, and plays it. */
function press(command) {
  state.held = [...state.held.filter((other) => other !== command), command];
  act(command);
}

/** Notes that a key or a button is held no more. */
function release(command) { state.held = state.held.filter((other) => other !== command); }

const commandOf = (event) => KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];

addEventListener("keydown", (event) => {
  const isControl = /^(INPUT|BUTTON)$/.test(event.target.tagName) || event.ctrlKey || event.metaKey || event.altKey;
  const command = commandOf(event);
  if (isControl || command === undefined || !isPlaying()) return;
  event.preventDefault();
  if (!event.repeat) press(command);
});
addEventListener("keyup", (event) => release(commandOf(event)));
addEventListener("blur", () => { state.held = []; });
addEventListener("hashchange", () => { if (location.hash) location.reload(); });
addEventListener("resize", () => show());

/** Makes the buttons of what one can do in the round. */
function buildPad() {
  const pad = element("pad");
  pad.replaceChildren();
  for (const [command, sign, word] of BUTTONS) {
    const isUsed = typeof command === "number" || state.round.actions.includes(command);
    if (!isUsed || (command === "stay" && state.round.turns_a_second !== null)) continue;
    const button = made("button", pad, sign);
    button.setAttribute("aria-label", word ? `${word} ${sign}` : ["up", "right", "down", "left"][command]);
    if (word) made("small", button, word);
    const let_go = () => { release(command); button.classList.remove("held"); };
    button.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      button.setPointerCapture(event.pointerId);
      button.classList.add("held");
      press(command);
    });
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) button.addEventListener(name, let_go);
    button.addEventListener("contextmenu", (event) => event.preventDefault());
  }
}

// The page

/** Makes what does not change in a round: scores, buttons, ballot, keys. */
function buildRound() {
  const {round} = state, list = element("agents");
  list.replaceChildren();
  const isApart = round.view === "board" || Object.keys(round.window_colours).some((kind) => kind >= CLASSES.agent);
  state.items = state.names.map((name, agent) => {
    const item = made("li", list, "", agent === state.me ? "me" : "");
    const chip = made("i", item, agent, isApart ? "hue" : "");
    if (isApart) chip.style.background = rgb(round.colours[agent]);
    item.append(`${name} `);
    return {item, words: made("b", item)};
  });
  buildPad();
  element("keys").replaceChildren();
  writeKeys(element("keys"));
  buildBallot();
}

/** Writes what the keys do. */
function writeKeys(parent) {
  const {actions, turns_a_second: pace} = state.round;
  const uses = [["← ↑ → ↓", "move", true], ["Q", "", true], ["E", "turn", true], ["F", "beam", actions.includes("beam")],
    ["space", "harvest", actions.includes("harvest")], ["C", "clean", actions.includes("clean")], ["X", "stay", pace === null]];
  for (const [key, words, isUsed] of uses) {
    if (!isUsed) continue;
    made("kbd", parent, key);
    parent.append(` ${words}${words && "  "}`);
  }
}

/** Says which agent one is, and how it moves. */
function writeHowTo(list) {
  const {round, me} = state, item = made("li", list, "You are ");
  const isBoard = round.view === "board", colour = isBoard ? round.colours[me] : round.window_colours[CLASSES.self];
  made("i", item, isBoard ? me : "▲", "chip").style.background = rgb(colour);
  item.append(isBoard ? ", in a white frame." : " at the bottom, and see what lies ahead.");
  writeKeys(made("li", list, "", "keys"));
  made("li", list, "Move by the buttons below the board; hold one to go on.", "touch");
}

/** Makes a button for each option of the vote. */
function buildBallot() {
  const ballot = element("ballot");
  ballot.querySelectorAll("button").forEach((button) => button.remove());
  (state.round.options ?? []).forEach((words, option) => {
    const button = made("button", ballot, words);
    button.type = "button";
    button.addEventListener("click", () => { state.vote = option; send("vote", {option}); show(); });
  });
}

/** Adds a line to the chat. */
function addLine(from, text) {
  state.lines = [...state.lines, [from, text]].slice(-MOST_LINES);
  sessionStorage.setItem(CHAT, JSON.stringify(state.lines));
  const lines = element("lines"), line = made("li", lines);
  made("b", line, from);
  made("span", line, text);
  lines.scrollTop = lines.scrollHeight;
}

/** Shows the page of the stage. */
function show() {
  if (document.body.dataset.connection === "refused") return;
  const {stage, round} = state, name = stage.stage, isOn = ["practice", "playing", "paused"].includes(name);
  const isGame = isOn && round && state.turn && !state.ended;
  document.body.dataset.stage = name;
  element("code").textContent = state.code ? `you are ${state.code}` : "";
  element("place").textContent = isGame ? placeWords() : "";
  for (const part of ["view", "scores", "pad"]) element(part).hidden = !isGame;
  element("reading").hidden = Boolean(isGame) || name === "joining";
  const hasChat = Boolean(round?.chat) && name !== "end" && name !== "consent";
  element("chat").hidden = !hasChat;
  document.querySelector("main").className = isGame ? "playing" : hasChat ? "talking" : "";
  if (isGame) showGame();
  else showReading();
}

/** Returns what people read of a treatment. */
const ruleName = (rule) => rule === "none" ? "no added rule" : rule;

/** Returns the round that is on, in words. */
function placeWords() {
  const {round, rounds, rule} = state.round;
  return round ? `Round ${round} of ${rounds}: ${ruleName(rule)}` : "Practice: nothing counts yet";
}

/** Shows the board or the window, and the scores. */
function showGame() {
  const {round, turn, me} = state, canvas = element("board");
  const isBoard = Boolean(turn.board);
  fitView(canvas, isBoard ? [round.width, round.height] : [state.sight.columns, state.sight.rows]);
  if (isBoard) {
    drawBoard(canvas, round, momentOf(round, turn.board), me);
  } else if (turn.window) drawWindow(canvas, state.sight, bytesOf(turn.window));
  showScores();
  const isIn = isBoard ? turn.board.poses[me] & IN_PLAY : turn.in_play ?? true;
  if (document.body.dataset.connection !== "open") return;
  if (state.stage.stage === "paused") say("The game waits until the others are back.");
  else if (!isIn) say("You were hit: off the board for now.");
  else if (state.chosen) say(`You chose: ${state.chosen.replace("_", " ")}. The others still choose.`);
  else if (round.turns_a_second === null) say("Choose what to do in this turn.");
  else say("");
}

/** Makes a canvas as large as its place allows. */
function fitView(canvas, [columns, rows]) {
  const place = canvas.parentNode;
  place.style.setProperty("--ratio", `${columns} / ${rows}`);
  const size = Math.min(place.clientWidth / columns, place.clientHeight / rows);
  canvas.style.width = `${Math.floor(size * columns)}px`;
  canvas.style.height = `${Math.floor(size * columns) / columns * rows}px`;
}

/** Shows what each has, the stock, and how long the round still lasts. */
function showScores() {
  const {round, turn, me} = state, left = Math.max(0, round.episode_steps - turn.turn), pace = round.turns_a_second;
  element("mine").textContent = number(turn.harvest[me]);
  const isOther = turn.income && turn.income[me] !== turn.harvest[me];
  element("mine-name").textContent = isOther ? `your apples (net ${number(turn.income[me])})` : "your apples";
  element("stock").parentNode.hidden = turn.stock === null;
  element("stock").textContent = `${number(turn.stock ?? 0)} / ${number(round.sites.length)}`;
  element("left").textContent = pace ? seconds(Math.ceil(left / pace)) : number(left);
  element("left-name").textContent = pace ? "left" : "turns left";
  element("time").max = round.episode_steps;
  element("time").value = turn.turn;
  element("in-force").textContent = turn.rule_in_force ? `In force: ${turn.rule_in_force}` : "";
  state.items.forEach(({item, words}, agent) => {
    const income = turn.income && turn.income[agent] !== turn.harvest[agent] ? ` (${number(turn.income[agent])})` : "";
    words.textContent = turn.harvest[agent] === null ? "" : `${number(turn.harvest[agent])}${income}`;
    item.classList.toggle("out", Boolean(turn.board) && !(turn.board.poses[agent] & IN_PLAY));
  });
}

/** Shows what is to be read before, between and after rounds. */
function showReading() {
  const {stage} = state, texts = element("text"), button = element("go");
  texts.replaceChildren();
  element("results").replaceChildren();
  element("ballot").hidden = true;
  button.hidden = true;
  element("waiting").textContent = "";
  if (document.body.dataset.connection === "open" && !element("said").querySelector("button")) say("");
  (state.ended && stage.stage !== "end" ? readEnded : READ[stage.stage])?.(texts, button);
}

/** Offers a button. */
function offer(button, words, does) {
  button.hidden = false;
  button.textContent = words;
  button.onclick = does;
}

const READ = {
  consent(texts, button) {
    element("subject").textContent = "Before you play";
    made("p", texts, state.consent ?? "");
    offer(button, "I agree", () => { send("consent"); button.disabled = false; });
    element("waiting").textContent = "If you do not agree, close this page.";
  },
  lobby(texts) {
    const {here, seats} = state.stage;
    element("subject").textContent = `${here} of ${seats} ${here === 1 ? "is" : "are"} here`;
    made("p", texts, "The game begins when all are here. Keep this page open.");
  },
  instructions: readRound,
  between: readRound,
  paused(texts) {
    element("subject").textContent = "The game waits";
    made("p", texts, "It goes on when the others are back. Keep this page open.");
  },
  practice: readStart,
  playing: readStart,
  end(texts) {
    element("subject").textContent = "The end. Thank you!";
    if (!state.end) return;
    if (state.end.completion_code) {
      const line = made("p", texts, "Your completion code: ");
      made("span", line, state.end.completion_code, "code");
    }
    if (state.end.rounds.length) resultTable(element("results"), state.end.rounds);
  },
};

/** Says that a round is about to begin. */
function readStart() { element("subject").textContent = "It begins…"; }

/** Shows the rules of the coming round, the results of the last one, and the vote. */
function readRound(texts, button) {
  const {round, stage, before} = state;
  if (!round) return;
  const isNew = round.round ? `Round ${round.round} of ${round.rounds}: ${ruleName(round.rule)}` : "First a practice round";
  element("subject").textContent = isNew;
  const list = made("ul", texts);
  writeHowTo(list);
  for (const sentence of round.instructions) made("li", list, sentence);
  if (before) {
    made("p", texts, before.round ? `Round ${before.round}, ${endWords(before)}` : `The practice, ${endWords(before)}`, "faint");
    if (before.round) resultTable(element("results"), [before]);
  }
  element("ballot").hidden = !round.options;
  element("ballot").querySelectorAll("button").forEach((choice, option) =>
    choice.setAttribute("aria-pressed", String(option === state.vote)));
  if (state.isReady) element("waiting").textContent = `${stage.ready} of ${stage.here} are ready. `;
  else offer(button, "I am ready", () => { state.isReady = true; send("ready"); show(); });
  showCountdown();
}

/** Returns how a round ended, in words. */
const endWords = (ended) => `after ${plural(ended.survival_steps, "turn")}: ${ended.ended}.`;

/** Shows how this group's round ended, while other groups may still play. */
function readEnded() {
  const {ended} = state;
  element("subject").textContent = `${ended.round ? "The round" : "The practice"} is over, ${endWords(ended)}`;
  resultTable(element("results"), [ended]);
  element("waiting").textContent = "It goes on in a moment.";
}

/** Shows the seconds until the stage ends by itself. */
function showCountdown() {
  if (!["instructions", "between"].includes(state.stage.stage) || state.ended) return;
  const left = state.until === null ? null : Math.max(0, Math.ceil((state.until - performance.now()) / 1000));
  const ready = state.isReady ? `${state.stage.ready} of ${state.stage.here} are ready. ` : "";
  element("waiting").textContent = ready + (left === null ? "" : `It begins in ${left} s at the latest.`);
}
setInterval(showCountdown, 500);

/** Draws a table of rounds: what each got, how long the board lasted, and the same of trained agents. */
function resultTable(parent, rounds) {
  const table = made("table", parent), head = made("tr", made("thead", table)), body = made("tbody", table);
  const agents = rounds[0].harvest.map((_, agent) => agent);
  const hasIncome = rounds.some((round) => round.income?.some((value, agent) => value !== round.harvest[agent]));
  made("th", head, hasIncome ? "apples (net of fines and transfers)" : "apples");
  for (const round of rounds) made("th", head, ruleName(round.rule));
  const row = (words, values, name = "") => {
    const line = made("tr", body, "", name);
    made("td", line, words);
    for (const value of values) made("td", line, value);
  };
  for (const agent of agents) {
    const values = rounds.map(({harvest, income}) =>
      number(harvest[agent]) + (income && income[agent] !== harvest[agent] ? ` (${number(income[agent])})` : ""));
    row(agentName(agent), values, agent === state.me ? "me" : "");
  }
  row("all together", rounds.map(({harvest}) => number(harvest.reduce((all, one) => all + one, 0))), "sum");
  row("turns that the board lasted", rounds.map((round) => number(round.survival_steps)));
  if (!rounds.some((round) => round.trained)) return;
  const trained = (name, digits) => rounds.map((round) => {
    if (!round.trained) return "–";
    const rounded = (value) => number(Number(value.toFixed(digits)));
    const interval = round.trained[`${name}_interval`];
    return rounded(round.trained[name]) + (interval ? ` [${interval.map(rounded).join(", ")}]` : "");
  });
  row("trained agents: each, on average", trained("harvest", 1), "sum");
  row("trained agents: turns, on average", trained("survival_steps", 0));
}

/** Returns what an agent is called. */
const agentName = (agent) => state.names?.[agent] ?? (agent === state.me ? "you" : `player ${agent}`);

element("chat").addEventListener("submit", (event) => {
  event.preventDefault();
  const text = element("line").value.trim();
  if (text) send("chat", {text});
  element("line").value = "";
  element("line").blur();
});

join();
