"use strict";
// The random numbers of scripted agents, as `cprl.policies.rng.LaneRng` takes them from numpy: SeedSequence and
// Philox4x64-10. 64-bit words are pairs of 32-bit words, the low one first. Needs game.js.

/** Returns numpy's `SeedSequence(seed).generate_state(count)` as int32; `seed`: integers, BigInts or texts. */
function seedState(seed, count) {
  const words = seed.flatMap(wordsOf);
  let constant = 0x43b0d7e5;
  const hashed = (given, multiplier) => {
    let value = given ^ constant;
    constant = Math.imul(constant, multiplier);
    value = Math.imul(value, constant);
    return value ^ (value >>> 16);
  };
  const pool = [0, 1, 2, 3].map((n) => hashed(words[n] ?? 0, 0x931e8875));
  const mix = (to, value) => { pool[to] = mixed(pool[to], hashed(value, 0x931e8875)); };
  for (let from = 0; from < 4; from++) {
    for (let to = 0; to < 4; to++) if (from !== to) mix(to, pool[from]);
  }
  for (const word of words.slice(4)) {
    for (let to = 0; to < 4; to++) mix(to, word);
  }
  constant = 0x8b51f9dd;
  return Array.from({ length: count }, (_, n) => hashed(pool[n % 4], 0x58f38ded));
}

/** Returns an integer as 32-bit words, the lowest first. */
function wordsOf(integer) {
  const words = [];
  let rest = BigInt(integer);
  do {
    words.push(Number(rest & 0xffffffffn) | 0);
    rest >>= 32n;
  } while (rest > 0n);
  return words;
}

function mixed(first, second) {
  const value = (Math.imul(0xca01f9dd, first) - Math.imul(0x4973f715, second)) | 0;
  return value ^ (value >>> 16);
}

/** Writes the product of two 64-bit words as four words, the lowest first. */
function multiply(low, high, otherLow, otherHigh, product) {
  const middle = highWord(low, otherLow) + (Math.imul(high, otherLow) >>> 0) + (Math.imul(low, otherHigh) >>> 0);
  const carried = Math.floor(middle / 2 ** 32);
  const upper = highWord(high, otherLow) + highWord(low, otherHigh) + (Math.imul(high, otherHigh) >>> 0) + carried;
  product[0] = Math.imul(low, otherLow);
  product[1] = middle;
  product[2] = upper;
  product[3] = highWord(high, otherHigh) + Math.floor(upper / 2 ** 32);
}

/** Adds a constant of 64 bits to a pair of words in `key`. */
function advance(key, at, low, high) {
  const sum = (key[at] >>> 0) + low;
  key[at] = sum;
  key[at + 1] += high + (sum >= 2 ** 32 ? 1 : 0);
}

/** Returns a number in [0, 1) with 53 bits. */
function double(low, high) {
  return ((high >>> 0) * 2 ** 21 + (low >>> 11)) / 2 ** 53;
}

/** The numbers of one agent; `seed`: as of `cprl.policies.rng.lane_seeds`. */
class Lane {
  constructor(seed) {
    this.seed = Int32Array.from(seedState(seed, 4));
    this.key = new Int32Array(4);
    this.counter = new Int32Array(8);
    this.first = new Int32Array(4);
    this.second = new Int32Array(4);
  }

  /** Writes the four numbers of a step into `numbers`; steps are counted from 0 and come in any order. */
  numbersOf(step, numbers) {
    this.key.set(this.seed);
    this.counter.fill(0);
    this.counter[0] = step + 1;
    for (let round = 0; round < 10; round++) this.mixRound();
    for (let n = 0; n < 4; n++) numbers[n] = double(this.counter[2 * n], this.counter[2 * n + 1]);
  }

  mixRound() {
    const { counter, key, first, second } = this;
    multiply(counter[0], counter[1], 0xe14c6c93, 0xd2e7470e, first);
    multiply(counter[4], counter[5], 0x95121157, 0xca5a8263, second);
    for (let n = 0; n < 2; n++) {
      counter[n] = second[2 + n] ^ counter[2 + n] ^ key[n];
      counter[2 + n] = second[n];
      counter[4 + n] = first[2 + n] ^ counter[6 + n] ^ key[2 + n];
      counter[6 + n] = first[n];
    }
    advance(key, 0, 0x7f4a7c15, 0x9e3779b9);
    advance(key, 2, 0x84caa73b, 0xbb67ae85);
  }
}
