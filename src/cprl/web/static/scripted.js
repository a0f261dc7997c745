"use strict";
// Scripted agents, as `cprl.policies.scripted` plays them. Needs game.js and lanes.js.

// The uses of the numbers of an agent in a turn; number 0 would make it explore.
const WHICH = 1;
const WANDERS = 2;
const WAITS = 3;
const WALK_ON_PROB = 0.9;
const WAIT_PROB = 0.5;
const FORWARD = 0;
const LEFT = 2;
const RIGHT = 3;
const TURN_LEFT = 4;
const TURN_RIGHT = 5;
const BEAM = 6;
/** The apples that a "sustainable" agent leaves near each apple that it harvests. */
const SPARE = 3;
/** The purpose of a lane's numbers, `cprl.policies.rng.Purpose.EVALUATION`. */
const EVALUATION = 4;

/** Returns the layout of the windows of a game: a window with a frame of wall around it, stored flat. */
function frameOf(tables) {
  const rows = tables.window_rows;
  const columns = tables.window_columns;
  const half = columns >> 1;
  const reach = Math.min(tables.near_reach, Math.max(rows, columns));
  const rim = Math.max(1, reach);
  const stride = columns + 2 * rim;
  const near = tables.near_steps.filter((step) => step.every((cells) => Math.abs(cells) <= reach));
  const cells = [];
  const offsets = [[], [], [], []];
  for (let row = 0; row < rows; row++) {
    for (let col = 0; col < columns; col++) {
      cells.push((row + rim) * stride + col + rim);
      offsets.forEach((seen, heading) => seen.push(boardOffset(tables, heading, rows - 1 - row, col - half)));
    }
  }
  return {
    rows,
    half,
    stride,
    size: stride * (rows + 2 * rim),
    middle: (rim + rows - 1) * stride + rim + half,
    cells: Int32Array.from(cells),
    offsets: offsets.map((seen) => Int32Array.from(seen)),
    neighbours: [-stride, -1, 1, stride],
    near: near.map(([row, col]) => row * stride + col),
  };
}

/** Returns the offset on the board from an agent's cell to one ahead of it and to its right. */
function boardOffset(tables, heading, ahead, side) {
  const right = (heading + 1) & 3;
  const rows = ahead * ROW_STEP[heading] + side * ROW_STEP[right];
  const cols = ahead * COL_STEP[heading] + side * COL_STEP[right];
  return rows * tables.stride + cols;
}

/** An agent that follows a policy, one of the names of `cprl.policies.scripted`. */
class ScriptedAgent {
  constructor(policy, tables, frame) {
    this.policy = policy;
    this.tables = tables;
    this.frame = frame;
    this.stay = tables.may_fire ? 7 : 6;
    this.beamHalf = Math.min(tables.beam_half_width, frame.half);
    this.beamLength = Math.min(...tables.beam_lengths);
    this.roles = new Uint8Array(frame.size).fill(WALL);
    this.blocked = new Uint8Array(frame.size);
    this.targets = new Uint8Array(frame.size);
    for (const name of ["steps", "othersSteps", "queue"]) this[name] = new Int32Array(frame.size);
  }

  /** Chooses the action of agent i; `numbers`: four uniform numbers in [0, 1). */
  choose(world, i, numbers) {
    if (this.policy === "random") return Math.floor(numbers[WHICH] * (this.stay + 1));
    this.look(world, i);
    if (this.fires()) return BEAM;
    this.targetApples();
    if (this.policy === "sustainable") this.excludeSparse();
    if (this.policy === "pacifist") this.excludeNearerToOthers();
    if (this.policy === "aggressive") {
      const action = this.pursue(numbers[WAITS]);
      if (action >= 0) return action;
      this.targetApples();
    }
    const goal = this.nearest();
    return goal < 0 ? this.wander(numbers[WANDERS]) : this.walkTo(goal, numbers[WAITS]);
  }

  /** Reads the roles of the cells in the window of agent i. */
  look(world, i) {
    const { cells, middle } = this.frame;
    const { roles } = this;
    const { ground } = world;
    const offsets = this.frame.offsets[world.heading[i]];
    const here = this.tables.cellOf(world.row[i], world.col[i]);
    for (let n = 0; n < cells.length; n++) roles[cells[n]] = ground[here + offsets[n]];
    for (let j = 0; j < world.row.length; j++) {
      if (world.onBoard[j]) this.lookFor(world, i, j);
    }
    this.roles[middle] = OPEN;
  }

  lookFor(world, i, j) {
    const { rows, half, middle, stride } = this.frame;
    const heading = world.heading[i];
    const right = (heading + 1) & 3;
    const rowsDown = world.row[j] - world.row[i];
    const colsRight = world.col[j] - world.col[i];
    const ahead = rowsDown * ROW_STEP[heading] + colsRight * COL_STEP[heading];
    const side = rowsDown * ROW_STEP[right] + colsRight * COL_STEP[right];
    const isSeen = ahead >= 0 && ahead < rows && Math.abs(side) <= half;
    if (isSeen) this.roles[middle + side - ahead * stride] = AGENT;
  }

  fires() {
    const mayFire = this.policy === "territorial" || this.policy === "aggressive";
    return mayFire && this.tables.may_fire && this.hasTarget(this.policy === "territorial");
  }

  /** Returns whether a beam would cover a visible agent; with `guards`, one that is near a visible apple. */
  hasTarget(guards) {
    const { middle, stride, near } = this.frame;
    for (let side = -this.beamHalf; side <= this.beamHalf; side++) {
      for (let ahead = 1; ahead <= this.beamLength; ahead++) {
        const cell = middle + side - ahead * stride;
        if (!(this.roles[cell] < WALL)) break;
        const isAgent = this.roles[cell] === AGENT;
        if (isAgent && (!guards || this.count(cell, near, APPLE) > 0)) return true;
      }
    }
    return false;
  }

  count(cell, offsets, role) {
    let count = 0;
    for (let n = 0; n < offsets.length; n++) {
      if (this.roles[cell + offsets[n]] === role) count += 1;
    }
    return count;
  }

  targetApples() {
    this.target(APPLE);
    for (const cell of this.frame.cells) this.blocked[cell] = this.roles[cell] === AGENT ? 1 : 0;
  }

  /** Makes all cells of a role targets. */
  target(role) {
    const { cells } = this.frame;
    this.targetCount = 0;
    for (let n = 0; n < cells.length; n++) {
      this.targets[cells[n]] = this.roles[cells[n]] === role ? 1 : 0;
      this.targetCount += this.targets[cells[n]];
    }
  }

  exclude(cell) {
    this.targetCount -= 1;
    this.targets[cell] = 0;
    this.blocked[cell] = 1;
  }

  excludeSparse() {
    const { cells, near } = this.frame;
    for (let n = 0; n < cells.length; n++) {
      const cell = cells[n];
      if (this.targets[cell] && this.count(cell, near, APPLE) < SPARE) this.exclude(cell);
    }
  }

  excludeNearerToOthers() {
    this.countSteps(false);
    this.countOthersSteps();
    for (const cell of this.frame.cells) {
      const others = this.othersSteps[cell];
      if (this.targets[cell] && others >= 0 && others < this.steps[cell]) this.exclude(cell);
    }
  }

  /** Counts the steps from the agent to each cell, or to those that are no farther than the nearest target. */
  countSteps(toTarget) {
    this.steps.fill(-1);
    this.steps[this.frame.middle] = 0;
    this.queue[0] = this.frame.middle;
    this.spread(this.steps, 1, toTarget);
  }

  /** Counts the steps from the nearest other agent to each cell. */
  countOthersSteps() {
    let known = 0;
    this.othersSteps.fill(-1);
    for (const cell of this.frame.cells) {
      if (this.roles[cell] !== AGENT) continue;
      this.othersSteps[cell] = 0;
      this.queue[known] = cell;
      known += 1;
    }
    this.spread(this.othersSteps, known, false);
  }

  /** Searches breadth-first from the first `known` cells of the queue; reaches blocked cells, passes none. */
  spread(steps, known, toTarget) {
    const { queue, roles, blocked, targets } = this;
    const { neighbours } = this.frame;
    for (let done = 0; done < known; done++) {
      const cell = queue[done];
      if (toTarget && targets[cell]) return;
      if (blocked[cell] && steps[cell] > 0) continue;
      for (let n = 0; n < 4; n++) {
        const beside = cell + neighbours[n];
        if (steps[beside] >= 0 || roles[beside] > AGENT) continue;
        steps[beside] = steps[cell] + 1;
        queue[known] = beside;
        known += 1;
      }
    }
  }

  /** Returns the nearest target, the first of equally near ones in reading order; -1 if none is reachable. */
  nearest() {
    const { cells } = this.frame;
    let best = -1;
    let fewest = this.steps.length;
    if (this.targetCount === 0) return best;
    this.countSteps(true);
    for (let n = 0; n < cells.length; n++) {
      const steps = this.steps[cells[n]];
      if (!this.targets[cells[n]] || steps < 0 || steps >= fewest) continue;
      best = cells[n];
      fewest = steps;
    }
    return best;
  }

  /** Returns the first cell on a shortest path. */
  stepTo(goal) {
    const { neighbours } = this.frame;
    let cell = goal;
    while (this.steps[cell] > 1) {
      let n = 0;
      while (!this.leads(cell, cell + neighbours[n])) n += 1;
      cell += neighbours[n];
    }
    return cell;
  }

  /** Returns whether a shortest path to a cell comes from the one beside it. */
  leads(cell, beside) {
    return this.steps[beside] === this.steps[cell] - 1 && !this.blocked[beside];
  }

  /** Returns the action of the first step on a shortest path; an agent may wait beside another one. */
  walkTo(goal, number) {
    const { neighbours, middle } = this.frame;
    const cell = this.stepTo(goal);
    if (number < WAIT_PROB && this.count(cell, neighbours, AGENT) > 0) return this.stay;
    if (cell === middle - 1) return LEFT;
    return cell === middle + 1 ? RIGHT : FORWARD;
  }

  wander(number) {
    const ahead = this.frame.middle - this.frame.stride;
    let rest = number;
    if (this.roles[ahead] <= APPLE && !this.blocked[ahead]) {
      if (number < WALK_ON_PROB) return FORWARD;
      rest = (number - WALK_ON_PROB) / (1 - WALK_ON_PROB);
    }
    return rest < 0.5 ? TURN_LEFT : TURN_RIGHT;
  }

  /** Turns or walks towards the nearest reachable agent; -1 if there is none. */
  pursue(number) {
    const { stride, middle } = this.frame;
    this.target(AGENT);
    const goal = this.nearest();
    if (goal < 0) return -1;
    const ahead = Math.floor(middle / stride) - Math.floor(goal / stride);
    const side = (goal % stride) - (middle % stride);
    if (Math.abs(side) <= ahead) return this.walkTo(goal, number);
    return side > 0 ? TURN_RIGHT : TURN_LEFT;
  }
}

/** One world with its scripted agents; world n of a batch is replica n, with one world each. */
class Population {
  constructor(policies, tables, seed, number) {
    const frame = frameOf(tables);
    this.world = new World(tables, seed, number);
    this.agents = policies.map((policy) => new ScriptedAgent(policy, tables, frame));
    this.lanes = policies.map((_, i) => new Lane([seed, number, i, EVALUATION]));
    this.numbers = [0, 0, 0, 0];
    this.chosen = 0;
  }

  /** Plays a turn, in which each agent chooses by the numbers of its lane. */
  play() {
    const actions = this.agents.map((agent, i) => {
      this.lanes[i].numbersOf(this.chosen, this.numbers);
      return agent.choose(this.world, i, this.numbers);
    });
    this.chosen += 1;
    this.world.play(actions);
  }
}
