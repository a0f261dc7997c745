"""A hosted game without a network: the stages that people go through, and the data that they leave."""

import asyncio
import json
from base64 import b64decode
from collections import Counter
from dataclasses import replace
from errno import ENOSPC
from io import FileIO
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hosted import Player, hosted, play_all, session, small_game
from hosted_runs import hosted as hosted_run

import cprl
from cprl import institutions, keys
from cprl.algorithms import PPO, RolloutSettings
from cprl.evaluation.fresh import fresh_episodes, record
from cprl.measuring.playing import evaluate
from cprl.policies.governors import Constant, StockRule
from cprl.population import Frozen, Learning, Person, Scripted
from cprl.runs import journal as journal_module
from cprl.runs.episodes import read_episodes
from cprl.runs.files import RunLockedError
from cprl.runs.journal import Journal, batches_in, read_journal
from cprl.training.agents import Population
from cprl.web import hall as hall_module, hosted_round
from cprl.web.hall import Hall, JoinRefusedError

NUMBERS = pa.schema({"number": pa.int64()})
COLUMNS = (
    *("turn", "ms", "group", "agent", "person", "given", "action", "cell", "heading", "in_play", "harvest"),
    *("reward", "fired", "tagged", "stock", "decision", "rule", "violated", "fines"),
)
TURNS = 6


def numbered(*numbers):
    return pa.record_batch({"number": numbers}, NUMBERS)


def rows(run):
    """The columns of a run's turns, as arrays."""
    table = pq.read_table(run / "turns.parquet")
    return SimpleNamespace(**{name: table[name].to_numpy() for name in table.column_names})


def two_rounds():
    return session(
        small_game(episode_steps=TURNS),
        groups=2,
        agents=("greedy",),
        rounds=(("none", ()), ("tax", (institutions.Tax(rate=0.5),))),
        practice_turns=2,
    )


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """A session of two groups that has ended, and its players."""
    out = tmp_path_factory.mktemp("hosted") / "out"
    with pytest.MonkeyPatch.context() as monkeypatch, hosted(out, two_rounds(), monkeypatch) as hall:
        players = [Player(hall).connect() for _ in range(4)]
        asyncio.run(play_all(hall, *players))
        yield SimpleNamespace(hall=hall, players=players, out=out)


def test_people_go_from_the_lobby_through_practice_and_all_rounds_to_the_end(ended):
    player = ended.players[0]
    stages = [message["stage"] for message in player.of("stage")]
    changes = [stage for before, stage in zip(["", *stages], stages, strict=False) if stage != before]
    assert changes == ["lobby", "instructions", "practice", "between", "playing", "between", "playing", "end"]
    assert [message["round"] for message in player.of("round")] == [0, 1, 2]
    assert next(message["names"] for message in ended.players[3].of("round")) == [
        "person 0",
        "you",
        "agent 2 (greedy)",
    ]
    end = ended.players[3].of("end")[0]
    assert [part["rule"] for part in end["rounds"]] == ["none", "tax"]
    assert len(end["completion_code"]) == 8
    assert end["rounds"][0]["income"] is None
    places = [(other.seat.group, other.seat.agent) for other in ended.players]
    assert places == [(0, 0), (0, 1), (1, 0), (1, 1)]


def test_each_round_is_a_run_of_people_whose_groups_are_replicas(ended):
    for number, laws in enumerate((0, 1), start=1):
        run = ended.out / f"round-{number}"
        loaded = cprl.load(run)
        assert loaded.specs[:2] == [Person()] * 2
        assert len(loaded.game.institutions) == laws
        played = rows(run)
        assert tuple(vars(played)) == COLUMNS
        episodes = read_episodes(run)
        assert episodes["replica"].to_pylist() == [0, 0, 0, 1, 1, 1]
        harvest = played.harvest.reshape(TURNS, 6).sum(0)
        assert harvest.tolist() == episodes["harvest"].to_pylist()
        assert harvest.any()
        assert np.array_equal(played.person, played.agent < 2)
        first = (run / "turns.csv").read_text().partition("\n")[0]
        assert first.replace('"', "").split(",") == list(COLUMNS)


def test_the_turns_of_a_round_are_those_of_the_game_with_the_same_actions(ended):
    played = rows(ended.out / "round-1")
    env = cprl.CommonsEnv(ended.hall.rounds[0].game, worlds=2, seed=ended.hall.session.seed)
    moment = env.reset()
    for turn in range(1, TURNS + 1):
        now = played.turn == turn
        moment[keys.ACTION] = moment["stock"].new_tensor(played.action[now]).long().reshape(2, 3)
        batch, moment = env.lean_step(moment, resets=False)
        assert batch["next", *keys.HARVEST].flatten().tolist() == played.harvest[now].tolist()
        assert batch["next", "stock"].flatten().tolist() == played.stock[now][::3].tolist()


def test_who_comes_back_after_the_end_sees_it_also_from_a_new_server(ended, tmp_path):
    player = Player(ended.hall, ended.players[1].secret).connect()
    assert player.of("end") == ended.players[1].of("end")
    seats = json.loads((ended.out / "session.json").read_text())["seats"]
    assert [seat["code"] for seat in seats] == [other.seat.code for other in ended.players]


def test_a_session_keeps_codes_and_hashes_and_no_secret(tmp_path, monkeypatch):
    with hosted(tmp_path / "out", session(consent="You may leave at any time."), monkeypatch) as hall:
        players = [Player(hall).connect() for _ in range(2)]
        assert players[0].of("welcome")[0]["consent"] == "You may leave at any time."
        players[0].say(type="ready")
        assert "too early" in players[0].of("error")[0]["why"]
        assert players[0].of("stage")[-1]["stage"] == "consent"
        for player in players:
            player.say(type="consent")
        last = players[0].of("stage")[-1]
        assert (last["stage"], last["here"], last["seats"]) == ("lobby", 2, 2)
    kept = (tmp_path / "out" / "session.json").read_text()
    table = json.loads(kept)
    assert all(seat["code"] and seat["consented"] and seat["secret"] for seat in table["seats"])
    assert table["session"]["consent"] == hall_module.digest("You may leave at any time.")
    assert not any(secret in kept for secret in (hall.token, *(player.secret for player in players)))
    assert (tmp_path / "out" / "join.txt").stat().st_mode & 0o077 == 0


def test_a_session_that_was_killed_goes_on_at_the_next_turn_with_the_same_seats(tmp_path, monkeypatch):
    plan = session(groups=2, agents=("greedy", "random"), seed=3)
    out = tmp_path / "out"
    with hosted(out, plan, monkeypatch) as hall:
        players = [Player(hall).connect() for _ in range(4)]
        asyncio.run(play_all(hall, *players, until=lambda: hall.rounds[0].turn >= 6))
        played = hall.rounds[0].turn
    journal = out / "round-1" / "turns.arrows"
    journal.write_bytes(journal.read_bytes()[:-1])  # the last turn was being written
    with hosted(out, plan, monkeypatch) as hall:
        again = [Player(hall, player.secret).connect() for player in players]
        codes = [(player.seat.code, player.seat.group, player.seat.agent) for player in players]
        assert [(player.seat.code, player.seat.group, player.seat.agent) for player in again] == codes
        asyncio.run(play_all(hall, *again))
        assert "paused" in [message["stage"] for message in again[0].of("stage")]
        assert again[0].of("turn")[0]["turn"] == played - 1
    turns = Counter(rows(out / "round-1").turn.tolist())
    assert turns == dict.fromkeys(range(1, 13), 8)
    assert read_episodes(out / "round-1").num_rows == 8


GOVERNED = replace(
    small_game(episode_steps=TURNS, regrow_prob=(0.0,)),
    institutions=(
        institutions.Tax(redistribution="none"),
        institutions.Governor(sets="tax.rate", options=(0.0, 0.5, 1.0), every_steps=2),
    ),
)


def test_a_governor_governs_people_and_what_they_played_is_replayed(tmp_path, monkeypatch):
    plan = session(GOVERNED, groups=2, agents=("greedy",), governor=StockRule(lower=0.7))
    with hosted(tmp_path / "out", plan, monkeypatch) as hall:
        players = [Player(hall).connect() for _ in range(4)]
        asyncio.run(play_all(hall, *players))
        shown = [message["rule_in_force"] for message in players[0].of("turn")]
    run = tmp_path / "out" / "round-1"
    played = rows(run)
    rule = played.rule.reshape(TURNS, 2, 3)
    assert (rule[::2] == rule[1::2]).all(), "it decides every other turn"
    sites = len(GOVERNED.map.sites)
    before = np.concatenate([[[sites] * 2], played.stock.reshape(TURNS, 2, 3)[1:-1:2, :, 0]])
    wanted = 1 - ((before / sites - 0.7) / 0.3).clip(0, 1)
    assert rule[::2, :, 0].tolist() == np.abs(np.arange(3) / 2 - wanted[..., None]).argmin(-1).tolist()
    assert len(np.unique(rule)) > 1
    assert shown[1:] == [f"the tax rate: {option / 2:g}" for option in rule[:, 0, 0]]
    assert played.fines == pytest.approx(played.harvest * played.rule / 2)
    assert cprl.load(run).experiment.governor == StockRule(lower=0.7)
    (again,) = map(record, fresh_episodes([run], replica=1))
    assert again.entry("rule")[:, None].tolist() == rule[:, 1, :1].tolist()


@pytest.mark.integration
def test_the_governor_of_the_run_that_is_hosted_governs_people(tmp_path, monkeypatch):
    learner = Learning(PPO(settings=RolloutSettings(rollout_steps=2, minibatch_size=2, hidden_cells=(4,))))
    experiment = cprl.Experiment(
        name="governed",
        game=GOVERNED,
        agents=(Scripted("greedy"),) * 2,
        governor=learner,
        episodes=2,
        evaluation_episodes=2,
    )
    monkeypatch.chdir(tmp_path)
    cprl.run(experiment, "trained", watch="off")
    rounds = (("governed", GOVERNED), ("none", ()))
    plan = session(game="trained", rounds=rounds, turns=TURNS, seed=9)
    with hosted(tmp_path / "out", plan, monkeypatch) as hall:
        players = [Player(hall).connect() for _ in range(2)]
        asyncio.run(play_all(hall, *players, until=lambda: hall.rounds[0].turn >= 3))
        rule = rows_so_far(hall.rounds[0])
    with hosted(tmp_path / "out", plan, monkeypatch) as hall:  # it decides the same again, by chance too
        again = [Player(hall, player.secret).connect() for player in players]
        asyncio.run(play_all(hall, *again))
    played = rows(tmp_path / "out" / "round-1")
    assert played.rule[: len(rule)].tolist() == rule
    assert set(played.rule) <= {0, 1, 2}
    assert cprl.load(tmp_path / "out" / "round-1").experiment.governor == Frozen("trained", 2)
    assert set(rows(tmp_path / "out" / "round-2").rule) == {-1}


def rows_so_far(played):
    return [
        rule for batch, _ in batches_in(played._journals["turns"].path) for rule in batch["rule"].to_pylist()
    ]


def test_a_governor_that_no_round_has_or_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"session\.governor"):
        session(governor=StockRule()).games()
    with pytest.raises(ValueError, match="number"):
        session(GOVERNED, governor=Constant(0.3)).games()


def test_a_journal_that_ends_anywhere_keeps_its_whole_batches(tmp_path):
    path = tmp_path / "rows.arrows"
    journal = Journal(path)
    ends = []
    for number in range(3):
        journal.add(numbered(number, number))
        ends.append(path.stat().st_size)
    journal.close()
    written = path.read_bytes()
    for size in range(0, len(written) + 1, 7):
        path.write_bytes(written[:size])
        whole = sum(end <= size for end in ends)
        assert [batch["number"][0].as_py() for batch, _ in batches_in(path)] == list(range(whole))
        journal = Journal(path)
        assert journal.rows == 2 * whole
        journal.add(numbered(7, 7))
        journal.close()
        assert len([*batches_in(path)]) == whole + 1


def test_a_full_disk_gets_no_part_of_a_batch(tmp_path, monkeypatch):
    class Disk(FileIO):
        free = 10_000

        def write(self, text):
            count = super().write(bytes(text)[: Disk.free])
            Disk.free -= count
            if not count:
                raise OSError(ENOSPC, "No space left on device")
            return count

    monkeypatch.setattr(journal_module, "FileIO", Disk)
    path = tmp_path / "turns.arrows"
    journal = Journal(path)
    journal.add(numbered(1))
    Disk.free = 20
    with pytest.raises(OSError, match="space"):
        journal.add(numbered(2))
    Disk.free = 10_000
    journal.add(numbered(3))
    journal.close()
    assert read_journal(path, NUMBERS)["number"].to_pylist() == [1, 3]


def test_a_turn_is_in_the_journal_before_anybody_sees_it(tmp_path, monkeypatch):
    with hosted(tmp_path / "out", session(), monkeypatch) as hall:
        players = [Player(hall).connect() for _ in range(2)]
        asyncio.run(play_all(hall, *players, until=lambda: len(players[0].of("turn")) > 3))
        stored = [batch["turn"][0].as_py() for batch, _ in batches_in(tmp_path / "out/round-1/turns.arrows")]
        assert stored[-1] >= players[0].of("turn")[-1]["turn"] > 2


def test_two_servers_cannot_write_one_session_and_another_session_is_refused(tmp_path, monkeypatch):
    with hosted(tmp_path / "out", session(), monkeypatch), pytest.raises(RunLockedError):
        Hall(session(), tmp_path / "out")
    with pytest.raises(ValueError, match="another session"):
        Hall(session(seed=8), tmp_path / "out")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").touch()
    with pytest.raises(FileExistsError):
        Hall(session(), tmp_path / "other")
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["thesis.txt"]


def test_a_folder_that_was_left_with_the_link_alone_is_begun_with_another_one(tmp_path):
    link = tmp_path / "out" / "join.txt"
    link.parent.mkdir()
    link.write_text("old")
    long_path = "a" * 300
    hall = Hall(session(), link.parent)
    hall.close()
    assert hall.token == link.read_text() != "old"
    assert link.stat().st_mode & 0o077 == 0
    assert session(runs=(long_path,)).runs == (long_path,)


def test_who_has_the_link_gets_a_seat_until_all_are_taken(tmp_path, monkeypatch):
    with hosted(tmp_path / "out", session(), monkeypatch) as hall:
        with pytest.raises(JoinRefusedError) as wrong:
            hall.join("guessed")
        players = [Player(hall) for _ in range(2)]
        with pytest.raises(JoinRefusedError) as full:
            hall.join(hall.token)
        assert (wrong.value.status, full.value.status) == (403, 409)
        assert "2 seats" in str(full.value)
        again = hall.join(hall.token, players[1].secret)
        assert again == {"seat_token": players[1].secret, "code": players[1].seat.code}
        assert hall.seat_of("guessed") is None
        assert hall.seat_of("") is None
        players[0].connect()
        players[1].connect()
        players[1].leave()
        monkeypatch.setattr(hall_module, "_FREE_AFTER_SECONDS", -1.0)
        new = Player(hall)
        assert (new.seat.group, new.seat.agent) == (0, 1)
        assert hall.seat_of(players[1].secret) is None


def test_a_newer_window_of_a_seat_replaces_the_older_one(tmp_path, monkeypatch):
    with hosted(tmp_path / "out", session(), monkeypatch) as hall:
        older = Player(hall).connect()
        newer = Player(hall, older.secret).connect()
        older.read()
        hall.leave(older.seat, older.outbox)
        assert older.closed == 4001
        assert newer.seat.outbox is newer.outbox


def action(**more):
    return json.dumps({"type": "action", "action": "forward", "number": 1, **more})


REFUSED = {
    "{": "no JSON",
    "[1]": "no JSON object",
    "[" * 1000: "no JSON",
    b"{}": "bytes",
    "x" * 1025: "too large",
    '{"type": "fly"}': "type is 'fly'",
    '{"type": ["action"]}': "type is",
    '{"type": "action", "action": "forward"}': "lacks number",
    action(action="fly"): "action is unknown",
    action(number=-1): "number is -1",
    action(number=True): "number is True",
    action(number=float("inf")): "number",
    action(number=float("nan")): "number",
    action(agent=1): "agent",
    '{"type": "view", "view": "board"}': "view is 'board'",
    '{"type": "vote", "option": 0}': "no vote",
    '{"type": "chat", "text": "hello"}': "no chat",
}


def test_a_message_that_is_not_allowed_gets_an_error_and_changes_nothing(tmp_path, monkeypatch):
    with hosted(tmp_path / "out", session(), monkeypatch) as hall:
        players = [Player(hall, actions=("stay",)).connect() for _ in range(2)]
        players[0].act(1)
        assert "no action" in players[0].of("error")[-1]["why"]
        assert players[0].seat.action == hall_module.NONE
        asyncio.run(play_all(hall, *players, until=lambda: hall.rounds[0].turn > 2))
        players[0].plays = False
        players[1].news.clear()
        before = [vars(player.seat) | {"budget": None} for player in players]
        for text, why in REFUSED.items():
            hall.receive(players[0].seat, text)
            assert why in players[0].of("error")[-1]["why"]
            assert [vars(player.seat) | {"budget": None} for player in players] == before, text
        assert not players[1].of("error")


def test_a_flood_is_limited_for_a_seat_also_over_new_sockets(tmp_path, monkeypatch):
    with hosted(tmp_path / "out", session(), monkeypatch) as hall:
        player = Player(hall).connect()
        for _ in range(45):
            player.say(type="ready").read()
        assert "too many" in player.of("error")[0]["why"]
        assert player.closed == 4008
        player.closed = None
        player.connect().say(type="ready").read()
        assert player.closed == 4008


@pytest.mark.parametrize(("absent", "moves"), [("stay", False), ("greedy", True)])
def test_who_has_left_stays_or_follows_a_script_and_the_data_say_so(tmp_path, monkeypatch, absent, moves):
    monkeypatch.setattr(hall_module, "_ABSENT_AFTER_SECONDS", -1.0)
    with hosted(tmp_path / "out", session(absent=absent), monkeypatch) as hall:
        players = [Player(hall, actions=("stay",)).connect() for _ in range(2)]

        def leave():
            if hall.rounds[0].turn == 4 and players[1].seat.outbox is not None:
                players[1].leave()
            return hall.stage == "end"

        asyncio.run(play_all(hall, *players, until=leave))
    played = rows(tmp_path / "out" / "round-1")
    left = (played.agent == 1) & (played.turn > 4)
    assert left.sum() == 8
    assert not played.person[left].any()
    assert not played.given[left].any()
    assert (played.action[left] != small_game().actions.index("stay")).any() == moves
    assert played.given[played.agent == 0].all()


def test_nobody_plays_who_has_not_consented_or_never_came(tmp_path, monkeypatch):
    with hosted(tmp_path / "out", session(people=3, consent="You may leave."), monkeypatch) as hall:
        player = Player(hall).connect().say(type="consent")
        Player(hall).connect()

        def is_over():
            hall.start_now()
            return hall.stage == "end"

        asyncio.run(play_all(hall, player, until=is_over))
    played = rows(tmp_path / "out" / "round-1")
    assert [played.person[played.agent == agent].any() for agent in range(3)] == [True, False, False]


def test_what_other_people_played_is_not_shown_as_of_trained_agents(tmp_path, monkeypatch):
    run = hosted_run(tmp_path / "people", small_game())
    plan = session(runs=(str(run),))
    with hosted(tmp_path / "out", plan, monkeypatch) as hall:
        assert cprl.load(run).game == hall.rounds[0].game
        assert hall.rounds[0].trained() is None


def test_trained_agents_stand_on_the_end_page_with_an_interval_over_replicas(tmp_path, monkeypatch):
    """Two replicas of 10 and 12 apples an agent: 11, and 12.706 x 1 beside it."""
    averages = {0: (100.0, 20.0), 1: (120.0, 24.0)}
    monkeypatch.setattr(hosted_round, "averages_of", lambda run: averages)
    with hosted(tmp_path / "out", session(), monkeypatch) as hall:
        this = hall.rounds[0]
        this._runs = [SimpleNamespace(game=this.game, specs=[])]
        trained = this.trained()
        assert (trained["harvest"], trained["survival_steps"]) == (11.0, 110.0)
        assert trained["harvest_interval"] == pytest.approx((0.0, 23.706), abs=0.001), "no harvest is below 0"
        del averages[1]
        assert this.trained() == {
            "harvest": 10.0,
            "harvest_interval": None,
            "survival_steps": 100.0,
            "survival_steps_interval": None,
        }


def test_people_vote_and_write_to_their_group_and_the_data_keep_both(tmp_path, monkeypatch):
    vote = institutions.Vote(on=institutions.Tax(), choices=(0.0, 0.5, 1.0))
    plan = session(people=3, groups=2, rounds=(("vote", (vote,)),), pause_seconds=30.0, chat=True)
    text = "<script>alert(1)</script> {0} %s \N{RED APPLE}"
    with hosted(tmp_path / "out", plan, monkeypatch) as hall:
        players = [Player(hall).connect() for _ in range(6)]

        def has_voted():
            if hall.stage == "instructions" and not players[0].seat.is_ready:
                for unprintable in ("\x1b[2J", " ", "\ud800", "x" * 201):
                    players[0].say(type="chat", text=unprintable)
                players[0].say(type="chat", text=text).say(type="vote", option=3)
                for player, option in zip(players, (2, 1, 0, 0, 0, 2), strict=True):
                    player.say(type="vote", option=option).say(type="ready")
            return hall.stage == "end"

        asyncio.run(play_all(hall, *players, until=has_voted))
    errors = [message["why"] for message in players[0].of("error")][:5]
    assert all("printable" in why for why in errors[:4])
    assert "0 to 2" in errors[4]
    options = players[0].of("round")[0]["options"]
    assert options == ["the tax rate: 0", "the tax rate: 0.5", "the tax rate: 1"]
    assert players[0].of("vote")[0]["result"] == ["the tax rate: 0.5"]
    assert players[5].of("turn")[-1]["rule_in_force"] == "the tax rate: 0"
    assert [player.of("chat") for player in players] == [
        *[[{"type": "chat", "from": "person 0", "text": text}]] * 3,
        *[[]] * 3,
    ]
    run = tmp_path / "out" / "round-1"
    played = rows(run)
    assert played.decision[played.turn == 1].tolist() == [2, 1, 0, 0, 0, 2]
    chat = pq.read_table(run / "chat.parquet").to_pylist()
    assert [(row["group"], row["agent"], row["text"]) for row in chat] == [(0, 0, text)]


def test_a_person_sees_the_window_of_an_agent_and_a_program_its_observation(tmp_path, monkeypatch):
    with hosted(tmp_path / "out", session(people=3, view="window"), monkeypatch) as hall:
        players = [Player(hall, actions=("stay",)).connect() for _ in range(3)]
        players[1].say(type="view", view="array")
        players[2].say(type="view", view="text")
        asyncio.run(play_all(hall, *players, until=lambda: hall.rounds[0].turn > 1))
        window, array, text = (player.of("turn")[-1] for player in players)
        shape = players[1].of("round")[0]["observation_shape"]
    assert "board" not in window
    assert [apples is None for apples in window["harvest"]] == [False, True, True]
    assert [apples is None for apples in text["harvest"]] == [True, True, False]
    assert window["stock"] is window["income"] is None, "the game has neither scoreboard nor gauge"
    assert len(b64decode(window["window"])) == 15
    observed = np.frombuffer(b64decode(array["observation"]), np.uint8).reshape(shape)
    assert observed.shape == (3, 3, 5)
    assert observed.any()
    lines = text["text"].split("\n")
    assert len(lines) == 3
    assert lines[-1][2] == "@"


def test_a_window_comes_with_the_numbers_that_the_game_shows(tmp_path, monkeypatch):
    sees = cprl.Observation(scoreboard=True, stock_gauge=True)
    game = replace(small_game(), observation=sees, institutions=(institutions.Tax(rate=0.5),))
    with hosted(tmp_path / "out", session(game, view="window"), monkeypatch) as hall:
        players = [Player(hall, actions=("stay",)).connect() for _ in range(2)]
        asyncio.run(play_all(hall, *players, until=lambda: hall.rounds[0].turn > 1))
        turn = players[0].of("turn")[-1]
    assert turn["stock"] > 0
    assert None not in turn["harvest"] + turn["income"]


def test_rounds_that_people_cannot_play_are_refused_by_name_before_anybody_joins(tmp_path):
    crowd = session(people=20, rounds=(("crowd", ()),))
    with pytest.raises(ValueError, match="round 'crowd': agents is 20"):
        Hall(crowd, tmp_path / "out")
    with pytest.raises(ValueError, match=r"session\.agents is 'trained'"):
        Hall(session(agents=("trained",)), tmp_path / "out")
    with pytest.raises(ValueError, match=r"session\.agents is 'gready'"):
        session(agents=("gready",))
    with pytest.raises(ValueError, match=r"session\.rounds"):
        session(rounds=(("none", "tax"),))
    assert not (tmp_path / "out").exists()


def test_a_board_is_enlarged_for_its_seats_and_the_turns_of_greedy_players_are_known(tmp_path, monkeypatch):
    dying = small_game(regrow_prob=(0.0, 0.0), episode_steps=60)
    with hosted(tmp_path / "out", session(game=dying, people=3), monkeypatch) as hall:
        assert hall.rounds[0].game.agents == 3
        greedy = [Scripted("greedy")] * 3
        env = cprl.CommonsEnv(hall.rounds[0].game, seed=hall.rounds[0].seed)
        (episode,) = evaluate(env, Population(env, greedy, seed=hall.rounds[0].seed).policy(1))
        assert 2 < episode.steps < 60
        assert episode.terminated
