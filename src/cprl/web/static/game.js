"use strict";
// The published game of cprl, as `cprl.commons` plays it: for one seed, world, episode and actions, the same numbers.
// A game comes from `cprl.web.playable.playable`, which refuses every rule that is not written here.

const ROW_STEP = [-1, 0, 1, 0];
const COL_STEP = [0, 1, 0, -1];
/** The turns to the right from a heading to the direction of a walk: forward, backward, left, right. */
const WALK_TURN = [0, 2, 3, 1];
/** The roles of cells, as agents see them. */
const OPEN = 0;
const APPLE = 1;
const AGENT = 2;
const WALL = 4;
const PLAYING = 0;
const TERMINATED = 1;
const TRUNCATED = 2;

// The purposes of draws, see `cprl.commons.chance`.
const REGROWTH_FIRST_BYTE = 0 << 28;
const REGROWTH_REST = 1 << 28;
const STARTS = 2 << 28;
/** The apples by which a harvest may exceed a quota, which allows for rounding errors. */
const ROUNDING = 1e-9;

/** Returns the high 32 bits of the product of two words, as an unsigned number. */
function highWord(first, second) {
  const firstHigh = first >>> 16;
  const firstLow = first & 0xffff;
  const secondHigh = second >>> 16;
  const secondLow = second & 0xffff;
  const middle = (Math.imul(firstLow, secondLow) >>> 16) + (Math.imul(firstHigh, secondLow) >>> 0);
  const upper = (middle & 0xffff) + (Math.imul(firstLow, secondHigh) >>> 0);
  return (Math.imul(firstHigh, secondHigh) + (middle >>> 16) + (upper >>> 16)) >>> 0;
}

/** Writes the four words of Philox4x32-10 for a counter and a key into `words`, an Int32Array. */
function philox4x32(counter, key, words) {
  let [c0, c1, c2, c3] = counter;
  let [k0, k1] = key;
  for (let round = 0; round < 10; round++) {
    const high0 = highWord(c0, 0xd2511f53);
    const high1 = highWord(c2, 0xcd9e8d57);
    const low0 = Math.imul(c0, 0xd2511f53);
    const low1 = Math.imul(c2, 0xcd9e8d57);
    c0 = high1 ^ c1 ^ k0;
    c1 = low1;
    c2 = high0 ^ c3 ^ k1;
    c3 = low0;
    k0 = (k0 + 0x9e3779b9) | 0;
    k1 = (k1 + 0xbb67ae85) | 0;
  }
  words[0] = c0;
  words[1] = c1;
  words[2] = c2;
  words[3] = c3;
}

/** Returns the lookup tables of a game; cells are counted row by row, with a rim of wall around the board. */
function tablesOf(game) {
  const half = game.window_columns >> 1;
  const rim = Math.max(game.window_rows - 1, half, 1);
  const stride = game.width + 2 * rim;
  const cellOf = (row, col) => (row + rim) * stride + col + rim;
  const isWall = new Uint8Array(stride * (game.height + 2 * rim)).fill(1);
  for (let row = 0; row < game.height; row++) {
    isWall.fill(0, cellOf(row, 0), cellOf(row, game.width));
  }
  for (const [row, col] of game.walls) isWall[cellOf(row, col)] = 1;
  const siteCells = game.sites.map(([row, col]) => cellOf(row, col));
  const siteAt = new Int32Array(isWall.length).fill(-1);
  siteCells.forEach((cell, site) => { siteAt[cell] = site; });
  const near = game.sites.map((site) => sitesNear(game, site, siteAt, cellOf));
  return { ...game, agents: game.starts.length, rim, stride, cellOf, isWall, siteCells, siteAt, near };
}

/** Returns the sites near a site. */
function sitesNear(game, [row, col], siteAt, cellOf) {
  const near = [];
  for (const [rows, cols] of game.near_steps) {
    const isInside = row + rows >= 0 && row + rows < game.height && col + cols >= 0 && col + cols < game.width;
    const site = isInside ? siteAt[cellOf(row + rows, col + cols)] : -1;
    if (site >= 0) near.push(site);
  }
  return Int32Array.from(near);
}

/** One world of a game; `tables` as of `tablesOf`, `seed` an integer, BigInt or text, 0 to 2**64 - 1. */
class World {
  constructor(tables, seed, number) {
    const wide = BigInt(seed);
    this.tables = tables;
    this.key = [Number(wide & 0xffffffffn) | 0, Number(wide >> 32n) | 0];
    this.counter = [0, 0, 0, number | 0];
    this.words = new Int32Array(4);
    this.episode = -1;
    this.step = 0;
    this.ended = PLAYING;
    const sites = tables.sites.length;
    this.stock = new Uint8Array(sites);
    this.ground = tables.isWall.map((isWall) => (isWall ? WALL : OPEN));
    this.stockLeft = 0;
    this.near = new Int32Array(sites);
    this.sprouts = new Int32Array(sites);
    this.firstBytes = new Int32Array(4 * Math.ceil(sites / 16));
    for (const name of ["row", "col", "heading", "startRow", "startCol"]) this[name] = new Int32Array(tables.agents);
    for (const name of ["inPlay", "onBoard", "fired", "isHit", "blocked"]) this[name] = new Uint8Array(tables.agents);
    for (const name of ["outSteps", "hits", "taggedStep", "harvest", "taken"]) this[name] = new Int32Array(tables.agents);
    this.allowed = Infinity;
  }

  /** Draws four words for this episode and step; `number`: the purpose of the draw and e.g. a site. */
  draw(number) {
    this.counter[0] = number;
    this.counter[1] = this.step;
    this.counter[2] = this.episode;
    philox4x32(this.counter, this.key, this.words);
    return this.words;
  }

  /** Begins the next episode. */
  begin() {
    const { starts, near, shuffle_starts: shuffles } = this.tables;
    this.episode += 1;
    this.step = 0;
    this.ended = PLAYING;
    this.stock.fill(1);
    this.stockLeft = this.stock.length;
    for (const cell of this.tables.siteCells) this.ground[cell] = APPLE;
    near.forEach((sites, site) => { this.near[site] = sites.length; });
    for (const name of ["outSteps", "hits", "taggedStep", "harvest", "fired"]) this[name].fill(0);
    this.inPlay.fill(1);
    this.onBoard.fill(1);
    starts.forEach((start, i) => this.place(i, start));
    if (shuffles) this.shuffleStarts();
    this.openWindow();
  }

  place(i, [row, col, heading]) {
    this.row[i] = row;
    this.col[i] = col;
    this.heading[i] = heading;
  }

  shuffleStarts() {
    for (let i = this.row.length - 1; i > 0; i--) {
      const j = (this.draw(STARTS | i)[0] >>> 0) % (i + 1);
      for (const places of [this.row, this.col, this.heading]) {
        [places[i], places[j]] = [places[j], places[i]];
      }
    }
  }

  /** Opens a window of the quota where one begins with the coming turn. */
  openWindow() {
    const { quota } = this.tables;
    if (quota === null || this.step % quota.window_steps !== 0) return;
    const part = quota.by_stock ? this.stockLeft / this.stock.length : 1;
    this.allowed = quota.share * part * quota.unit;
    this.taken.fill(0);
  }

  /** Plays a turn; `actions`: the number of each agent's action. */
  play(actions) {
    if (this.ended !== PLAYING) return;
    this.step += 1;
    this.countDown();
    for (let i = 0; i < this.row.length; i++) this.act(i, actions[i]);
    this.settleClashes();
    const sprouts = this.findSprouts();
    this.harvestApples();
    for (let n = 0; n < sprouts; n++) this.change(this.sprouts[n], 1);
    this.findHits();
    this.tag();
    this.checkEnd();
    this.onBoard.set(this.inPlay);
    this.returnToPlay();
    this.keepOnBoard();
    this.openWindow();
  }

  countDown() {
    for (let i = 0; i < this.outSteps.length; i++) {
      if (this.outSteps[i] > 0) this.outSteps[i] -= 1;
    }
  }

  act(i, action) {
    this.startRow[i] = this.row[i];
    this.startCol[i] = this.col[i];
    this.fired[i] = 0;
    if (!this.inPlay[i]) return;
    if (action < 4) this.walk(i, (this.heading[i] + WALK_TURN[action]) & 3);
    else if (action === 4) this.heading[i] = (this.heading[i] + 3) & 3;
    else if (action === 5) this.heading[i] = (this.heading[i] + 1) & 3;
    else if (action === 6 && this.tables.may_fire) this.fired[i] = 1;
  }

  walk(i, direction) {
    const { isWall, cellOf } = this.tables;
    const row = this.row[i] + ROW_STEP[direction];
    const col = this.col[i] + COL_STEP[direction];
    if (isWall[cellOf(row, col)]) return;
    this.row[i] = row;
    this.col[i] = col;
  }

  hasMoved(i) {
    return this.row[i] !== this.startRow[i] || this.col[i] !== this.startCol[i];
  }

  shareACell(i, j) {
    return this.row[i] === this.row[j] && this.col[i] === this.col[j];
  }

  stoodAt(i, j) {
    return this.row[i] === this.startRow[j] && this.col[i] === this.startCol[j];
  }

  isInAClash(i) {
    for (let j = 0; j < this.row.length; j++) {
      const clashes = this.shareACell(i, j) || (this.stoodAt(i, j) && this.stoodAt(j, i));
      if (j !== i && this.inPlay[j] && clashes) return true;
    }
    return false;
  }

  /** Moves all agents back that moved into a clash, until no agents clash. */
  settleClashes() {
    let isSettled = false;
    while (!isSettled) {
      isSettled = true;
      for (let i = 0; i < this.row.length; i++) {
        this.blocked[i] = this.inPlay[i] && this.hasMoved(i) && this.isInAClash(i) ? 1 : 0;
        if (this.blocked[i]) isSettled = false;
      }
      for (let i = 0; i < this.row.length; i++) {
        if (this.blocked[i]) this.goBack(i);
      }
    }
  }

  goBack(i) {
    this.row[i] = this.startRow[i];
    this.col[i] = this.startCol[i];
  }

  /** Writes the empty sites that grow an apple into `sprouts`; returns their number. Draws only what decides. */
  findSprouts() {
    const below = this.tables.regrow_below;
    let count = 0;
    let lastDraw = -1;
    for (let site = 0; site < this.stock.length; site++) {
      const threshold = below[this.near[site]];
      if (this.stock[site] || threshold === 0) continue;
      const drawNumber = site >> 4;
      if (drawNumber !== lastDraw) {
        this.firstBytes.set(this.draw(REGROWTH_FIRST_BYTE + drawNumber), 4 * drawNumber);
        lastDraw = drawNumber;
      }
      if (this.hasSprouted(site, threshold)) this.sprouts[count++] = site;
    }
    return count;
  }

  hasSprouted(site, threshold) {
    const firstByte = (this.firstBytes[site >> 2] >>> (8 * (site & 3))) & 255;
    const least = firstByte * 2 ** 24;
    if (least >= threshold) return false;
    return least + (this.draw(REGROWTH_REST + site)[0] >>> 8) < threshold;
  }

  /** Adds an apple to a site, or takes it away where `by` is -1. */
  change(site, by) {
    const sites = this.tables.near[site];
    this.stock[site] += by;
    this.ground[this.tables.siteCells[site]] = this.stock[site] ? APPLE : OPEN;
    this.stockLeft += by;
    for (let n = 0; n < sites.length; n++) this.near[sites[n]] += by;
  }

  harvestApples() {
    const { siteAt, cellOf } = this.tables;
    for (let i = 0; i < this.row.length; i++) {
      const site = siteAt[cellOf(this.row[i], this.col[i])];
      const mayHarvest = this.inPlay[i] && this.taken[i] + 1 <= this.allowed + ROUNDING;
      this.harvest[i] = mayHarvest && site >= 0 && this.stock[site] ? 1 : 0;
      if (!this.harvest[i]) continue;
      this.change(site, -1);
      this.taken[i] += 1;
    }
  }

  /** Returns whether the beam of a shooter covers the cell of agent i. */
  covers(shooter, i) {
    const heading = this.heading[shooter];
    const right = (heading + 1) & 3;
    const rows = this.row[i] - this.row[shooter];
    const cols = this.col[i] - this.col[shooter];
    const ahead = rows * ROW_STEP[heading] + cols * COL_STEP[heading];
    const side = rows * ROW_STEP[right] + cols * COL_STEP[right];
    if (ahead < 1 || ahead > this.tables.beam_lengths[heading]) return false;
    if (Math.abs(side) > this.tables.beam_half_width) return false;
    return !this.hasWall(shooter, ahead, side);
  }

  /** Returns whether a wall stands in a column of a beam, up to the cell `ahead`. */
  hasWall(shooter, ahead, side) {
    const { isWall, cellOf } = this.tables;
    const heading = this.heading[shooter];
    const right = (heading + 1) & 3;
    const row = this.row[shooter] + side * ROW_STEP[right];
    const col = this.col[shooter] + side * COL_STEP[right];
    for (let cells = 1; cells <= ahead; cells++) {
      if (isWall[cellOf(row + cells * ROW_STEP[heading], col + cells * COL_STEP[heading])]) return true;
    }
    return false;
  }

  findHits() {
    this.isHit.fill(0);
    for (let shooter = 0; shooter < this.row.length; shooter++) {
      if (!this.fired[shooter]) continue;
      for (let i = 0; i < this.row.length; i++) {
        if (i !== shooter && this.inPlay[i] && this.covers(shooter, i)) this.isHit[i] = 1;
      }
    }
  }

  tag() {
    for (let i = 0; i < this.row.length; i++) {
      if (!this.isHit[i]) continue;
      this.hits[i] += 1;
      if (this.hits[i] < this.tables.hits_to_tag) continue;
      this.hits[i] = 0;
      this.inPlay[i] = 0;
      this.taggedStep[i] = this.step;
      this.outSteps[i] = Math.max(this.outSteps[i], this.tables.freeze_steps);
    }
  }

  checkEnd() {
    const { regrow_below: below, episode_steps: steps } = this.tables;
    if (this.stockLeft === 0 && below[0] === 0) this.ended = TERMINATED;
    else if (this.step >= steps) this.ended = TRUNCATED;
  }

  returnToPlay() {
    for (let i = 0; i < this.row.length; i++) {
      this.blocked[i] = this.inPlay[i] || this.outSteps[i] > 0 || this.hasToWait(i) ? 1 : 0;
    }
    for (let i = 0; i < this.row.length; i++) {
      if (!this.blocked[i]) this.inPlay[i] = 1;
    }
  }

  hasToWait(i) {
    for (let j = 0; j < this.row.length; j++) {
      const isFirst = this.outSteps[j] === 0 && this.taggedStep[j] < this.taggedStep[i];
      if (j !== i && this.shareACell(i, j) && (this.inPlay[j] || isFirst)) return true;
    }
    return false;
  }

  /** Keeps agents on the board that were tagged in this turn but miss no turn. */
  keepOnBoard() {
    for (let i = 0; i < this.row.length; i++) {
      if (this.inPlay[i] && this.taggedStep[i] === this.step) this.onBoard[i] = 1;
    }
  }
}
