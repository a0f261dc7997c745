// node play_held.js GAMES: plays the games of the file and compares them with what Python played.
"use strict";
const { createHash } = require("node:crypto");
const { readFileSync } = require("node:fs");
const path = require("node:path");

const folder = path.join(__dirname, "../../src/cprl/web/static");
const sources = ["game.js", "lanes.js", "scripted.js"].map((name) => readFileSync(path.join(folder, name), "utf8"));
const { tablesOf, Population } = new Function(`${sources.join("\n")}\nreturn { tablesOf, Population };`)();

/** Returns the state of a world in a turn, as bytes. */
function bytesOf(world) {
  const { row, col, heading, inPlay, fired, harvest, stockLeft, ended, stock } = world;
  const agents = [row, col, heading, inPlay, fired, harvest].flatMap((numbers) => [...numbers]);
  return Int32Array.from([...agents, stockLeft, ended, ...stock]);
}

/** Returns the action of an agent that walks about, turns and fires, two times of three forward. */
function move(turn, agent, actions) {
  const word = Math.imul(Math.imul(turn * 64 + agent + 1, 0x9e3779b1) ^ 0x5bd1e995, 0x85ebca6b) >>> 8;
  return word % 3 === 0 ? (word >>> 8) % actions : 0;
}

/** Plays one held game; returns the turns of its episodes, and digests of all turns so far. */
function played(held, given, every) {
  const tables = tablesOf(given);
  const population = new Population(held.policies ?? [], tables, held.seed, held.world);
  const world = population.world;
  const hash = createHash("sha256");
  const turns = [];
  const digests = [];
  for (let episode = 0; episode < held.episodes; episode++) {
    world.begin();
    hash.update(bytesOf(world));
    while (world.ended === 0) {
      if (held.policies) population.play();
      else world.play(tables.starts.map((_, i) => move(world.step, i, tables.may_fire ? 8 : 7)));
      hash.update(bytesOf(world));
      if (world.step % every === 0 || world.ended) digests.push(hash.copy().digest("hex").slice(0, 8));
    }
    turns.push(world.step);
  }
  return { turns, digests };
}

const { every, specs, games } = JSON.parse(readFileSync(process.argv[2], "utf8"));
let unequal = 0;
let turns = 0;
for (const held of games) {
  const found = played(held, specs[held.game], every);
  const at = held.digests.findIndex((digest, n) => digest !== found.digests[n]);
  turns += found.turns.reduce((sum, number) => sum + number, 0);
  if (at < 0 && String(found.turns) === String(held.turns)) continue;
  unequal += 1;
  const where = `game ${held.game}, seed ${held.seed}, world ${held.world}, ${held.policies ?? "moves"}`;
  console.log(`${where}: unequal from digest ${at}, turns ${found.turns} for ${held.turns}`);
}
console.log(`${games.length} games, ${turns} turns, ${unequal} unequal`);
process.exit(unequal ? 1 : 0);
