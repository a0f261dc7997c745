const controls = [...document.querySelectorAll(".controls input, .controls select")];
let asked = 0, timer = 0, isTrained = false;

const query = () => new URLSearchParams(controls.map((own) => [own.name, own.value]));
const say = (words) => { element("said").textContent = words; };

/** The answer of the server; an error says what it says. */
async function ask(path, more = {}, options = {}) {
  const words = query();
  for (const [name, value] of Object.entries(more)) words.set(name, value);
  const answer = await fetch(`${path}?${words}`, options);
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

/** Plays an episode by the sliders as they are; an answer that comes after a later question is dropped. */
async function replay() {
  const number = ++asked;
  say("playing …");
  try {
    const data = await (await ask("data", isTrained ? {trained: "yes"} : {})).json();
    if (number !== asked) return;
    element("turn").closest("section").hidden = false;
    await load(data);
    go(0);
    play(true);
    say("");
  } catch (error) {
    if (number === asked) say(error.message);
  }
}

function write() {
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
  own.addEventListener("input", () => { write(); clearTimeout(timer); timer = setTimeout(replay, 250); });
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
