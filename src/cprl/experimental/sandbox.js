const controls = [...document.querySelectorAll(".controls input, .controls select")];
let asked = 0, timer = 0, isTrained = false, earlier = "";

const query = () => new URLSearchParams(controls.map((own) => [own.name, own.value]));
const say = (words) => { element("said").textContent = words; };

/** Greys the board, which is not that of the sliders any more. */
function grey() {
  play(false);
  element("populations").style.opacity = .3;
  say("playing your rules … the first quota, tax or sanction compiles for about a minute, once");
}

/** Says how the episode ends, at once, and how the one before it ended. */
function compare() {
  const now = populations.map((own) => {
    const apples = own.harvested.subarray(own.last * own.agents).reduce((all, one) => all + one, 0);
    return `${own.title}: ${number(apples)} apples picked, ${own.outcome}`;
  }).join(". ");
  element("results").textContent = `Now: ${now}.${earlier && ` Before: ${earlier}.`}`;
  earlier = now;
}

/** The answer of the server; an error says what it says. */
async function ask(path, more = {}, options = {}) {
  const words = query();
  for (const [name, value] of Object.entries(more)) words.set(name, value);
  const answer = await fetch(`${path}?${words}`, options);
  if (!answer.ok) throw Object.assign(new Error(await answer.text()), {status: answer.status});
  return answer;
}

/** Plays an episode by the sliders as they are; an answer that comes after a later question is dropped. */
async function replay() {
  const number = ++asked;
  grey();
  try {
    const data = await (await ask("data", isTrained ? {trained: "yes"} : {})).json();
    if (number !== asked) return;
    element("turn").closest("section").hidden = false;
    await load(data);
    compare();
    element("populations").style.opacity = 1;
    go(0);
    play(true);
    say("");
  } catch (error) {
    if (number !== asked) return;
    if (error.status === 409) setTimeout(replay, 500);  // another window asked later
    else say(error.message);
  }
}

function write() {
  document.querySelector("[name=greedy]").max = document.querySelector("[name=agents]").value;
  for (const own of controls) {
    const value = own.parentNode.querySelector("span");
    if (value) value.textContent = own.name === "sanctions" ? (own.value === "1" ? "yes" : "no") : own.value;
  }
}

async function watchTraining() {
  const {state, line} = await (await ask("state")).json();
  element("train").disabled = state === "training";
  if (state === "training") {
    say(`training: ${line}`);
    setTimeout(watchTraining, 1000);
  } else if (state === "trained") {
    isTrained = true;
    replay();
  } else say(`the training failed: ${line}`);
}

for (const own of controls) {
  own.addEventListener("input", () => {
    asked++;  // an answer that is under way is of other rules
    write();
    grey();
    clearTimeout(timer);
    timer = setTimeout(replay, 250);
  });
}
element("train").addEventListener("click", async () => {
  try {
    await ask("train", {}, {method: "POST"});
    watchTraining();
  } catch (error) { say(error.message); }
});
element("recipe").addEventListener("click", async () => {
  const text = await (await ask("recipe")).text();
  try {
    await navigator.clipboard.writeText(text);
    say("The recipe is on the clipboard: save it as mine.py, and run python mine.py.");
  } catch { say(""); }
  const shown = document.querySelector("#text") || made("pre", element("said").parentNode);
  shown.id = "text";
  shown.textContent = text;
});
write();
replay();
