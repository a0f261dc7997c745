// The sixth step of the page: boards and rules of one's own, which need Python beside the page.

const OWN_MAP = "your own map";
const wanted = { board: "commons", drawing: "" };
const part = (name) => document.querySelector(`#own [name=${name}]`);
let question = 0;
let waiting = 0;
let isTraining = false;
let trained = null;
let course = [];
let learnedUnder = "";

const sayOwn = (words) => { element("said").textContent = words; };

/** Asks the server; an error says what it says. */
async function ask(path, body = {}) {
  const answer = await fetch(path, { method: "POST", body: JSON.stringify(body) });
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

/** Returns the settings that the server reads. */
function sliders() {
  const { hold, board, drawing, ...numbers } = wanted;
  return board === OWN_MAP ? { drawing, ...numbers } : { board, ...numbers };
}

/** Plays by the settings as they are; an answer to an earlier question is dropped. */
function askGame() {
  question += 1;
  stage.wait("Playing your rules …");
  clearTimeout(waiting);
  waiting = setTimeout(() => playGame(question), 120);
}

async function playGame(number) {
  try {
    const { scene, game, drawing } = await ask("game", sliders());
    if (number !== question || !STEPS[step].show) return;
    if (wanted.board !== OWN_MAP) wanted.drawing = drawing;
    stage.show(ownTrial(scene, game));
    sayOwn("");
  } catch (error) {
    if (number === question) stage.wait(error.message);
  }
}

function ownTrial(scene, game) {
  const agents = game.starts.length;
  const policies = game.starts.map((_, i) => (i < wanted.hold ? "sustainable" : "greedy"));
  const name = `${wanted.hold ? `${wanted.hold} of ${agents} hold back` : `${agents} greedy`}${rulesOf(wanted)}`;
  return { scene, tables: tablesOf(game), policies, name };
}

/** Returns what is not as on the published board, in words. */
function rulesOf({ board, drawing, agents, regrowth, sight, quota, tax, sanctions }, others = "") {
  const name = drawing && others ? OWN_MAP : board;
  const parts = {
    [name]: name !== "commons",
    [`${agents} agents`]: others && agents !== 4,
    [`growth x ${regrowth}`]: regrowth !== 1,
    [`sight ${sight}`]: sight !== 7,
    [`quota ${quota}`]: quota,
    [`tax ${tax}`]: others && tax,
    sanctions: others && sanctions,
    [others]: others && !quota && !tax && !sanctions,
  };
  return Object.keys(parts).filter((words) => parts[words]).map((words) => `, ${words}`).join("");
}

/** Makes a slider of the page change its setting. */
function watchSlider(input) {
  const { name } = input;
  const shown = input.parentNode.querySelector("span");
  wanted[name] = Number(input.value);
  shown.textContent = input.value;
  input.addEventListener("input", () => {
    wanted[name] = Number(input.value);
    shown.textContent = input.value;
    if (name === "agents") limitHold();
    if (!input.closest(".idle")) askGame();
    else sayOwn(`Nothing changes for scripted agents: they do not mind ${name}. Train these to see.`);
  });
}

/** Keeps those who hold back among the agents that there are. */
function limitHold() {
  const input = part("hold");
  input.max = wanted.agents;
  wanted.hold = Number(input.value);
  input.parentNode.querySelector("span").textContent = input.value;
}

function watchBoard() {
  const text = part("drawing");
  part("board").addEventListener("input", (event) => {
    wanted.board = event.target.value;
    text.hidden = wanted.board !== OWN_MAP;
    text.value = wanted.drawing;
    askGame();
    if (!text.hidden) sayOwn("A is an apple, . ground, # a wall, > ^ < v an agent. All rows are equally long.");
  });
  text.addEventListener("input", () => {
    wanted.drawing = text.value;
    askGame();
  });
}

/** Draws the apples of each episode of a training. */
function drawCourse() {
  const canvas = element("course");
  canvas.hidden = course.length < 2;
  if (canvas.hidden) return;
  const [pen, wide, high] = penOf(canvas);
  const most = Math.max(...course);
  const style = getComputedStyle(document.body);
  pen.fillStyle = style.getPropertyValue("--faint");
  pen.font = "13px system-ui, sans-serif";
  pen.fillText(`apples in each of ${number(course.length)} episodes, 0 to ${rounded(most)}`, 0, 13);
  pen.strokeStyle = style.getPropertyValue("--green");
  pen.lineWidth = 2;
  pen.beginPath();
  course.forEach((apples, at) => pen.lineTo(at / (course.length - 1) * wide, high - 2 - (high - 24) * apples / most));
  pen.stroke();
}

/** Follows a training until it ends. */
async function watchTraining() {
  const { state, line, course: found, sliders: settingsThen } = await ask("state");
  if (state === "none") return;
  course = found;
  learnedUnder = `trained${rulesOf(settingsThen, "no rule")}`;
  isTraining = state === "training";
  element("train").disabled = isTraining;
  drawCourse();
  if (isTraining) {
    sayOwn(`To be ${learnedUnder}: ${line}`);
    setTimeout(watchTraining, 1000);
  } else if (state === "trained") await showTrained();
  else if (state === "failed") sayOwn(`The training failed: ${line}`);
}

/** Fetches the trained agents' episode, shows it and keeps their averages as a diamond. */
async function showTrained() {
  sayOwn("The trained agents play …");
  trained = await ask("trained");
  await unpack(trained);
  trained.name = learnedUnder;
  question += 1;
  stage.mark(trained);
  element("show-trained").hidden = false;
  sayOwn(`The diamond is the mean of the agents "${learnedUnder}" in fresh worlds.`);
  if (STEPS[step].show) stage.showRecorded(trained);
  else stage.drawTries();
}

async function copyRecipe() {
  const text = await ask("recipe", sliders());
  element("text").textContent = text;
  element("text").hidden = false;
  try {
    await navigator.clipboard.writeText(text);
    sayOwn("The recipe is on the clipboard: save it as mine.py, and run python mine.py.");
  } catch { sayOwn("Save this as mine.py, and run python mine.py."); }
}

/** Calls what a button does, and says what goes wrong. */
function onClick(id, does) {
  element(id).addEventListener("click", () => does().catch((error) => sayOwn(error.message)));
}

addEventListener("resize", drawCourse);
watchBoard();
document.querySelectorAll("#own input").forEach(watchSlider);
onClick("train", async () => {
  await ask("train", sliders());
  await watchTraining();
});
onClick("show-trained", async () => {
  question += 1;
  stage.showRecorded(trained);
});
onClick("recipe", copyRecipe);
STEPS.push({
  short: "Your own",
  title: "Your own field",
  idea: "Choose a board or draw one, and set its rules. Scripted agents play at once; agents that learn need a minute.",
  sliders: [],
  show: askGame,
});
addStep(STEPS.at(-1), STEPS.length - 1);
openStep(STEPS.length - 1);
watchTraining();
