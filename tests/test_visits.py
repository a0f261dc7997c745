"""Where agents of stored runs go in fresh worlds: measured beside random play, drawn, and told in a table."""

import numpy as np
import pytest
from matplotlib.image import imread
from stored_runs import SEED

import cprl
from cprl.evaluation import territory_of
from cprl.evaluation.territory import DEFENCE, EXCLUSION, OVERLAP, TAGS, VISITORS, draw_visits


def test_agents_in_corridors_of_their_own_exclude_each_other(corridors):
    found = territory_of(corridors["greedy"], episodes=4)
    measured = found.trained.measures()
    assert measured[EXCLUSION].value == measured[VISITORS].value == 1
    assert measured[OVERLAP].value == measured[TAGS].value == 0
    assert DEFENCE not in measured, "nobody can fire"
    # Agent 0 starts at (0, 0) and bites at columns 1 and 3 in steps 1 and 3; the cell of step t is that at
    # its start. Agent 1 starts at (2, 4) and walks left. After step 3 the board is dead.
    assert found.trained.visits.shape == (2, 2, 3, 5)
    np.testing.assert_allclose(found.trained.visits[0, 0, 0], [1 / 3, 1 / 3, 1 / 3, 0, 0])
    np.testing.assert_allclose(found.trained.visits[1, 1, 2], [0, 0, 1 / 3, 1 / 3, 1 / 3])


def test_the_episodes_are_those_of_an_evaluation(alike):
    found, played = (ask(alike, episodes=5, seed=SEED) for ask in (territory_of, cprl.evaluate_run))
    for policy in ("trained", "random"):
        stays = found.of(policy)
        for place, replica in enumerate(found.fresh.replicas):
            episodes = getattr(played, policy)[replica]
            tagged_by = sum(own.tagged_by for own in episodes)
            assert stays.taggings[place].tolist() == tagged_by.tolist()
            tagged = sum(own.tagged for own in episodes)
            assert stays.tagged_where[place].sum((1, 2)).tolist() == tagged.tolist()
            per_1000 = 1000 * tagged_by.sum() / sum(own.steps for own in episodes)
            assert stays.by_replica[TAGS][place] == pytest.approx(per_1000)
    assert found.random.taggings.sum() > 0


def test_the_maps_show_where_each_agent_was_and_are_not_written_over(corridors, tmp_path):
    found = territory_of(corridors["greedy"], episodes=2)
    path = draw_visits(found, tmp_path / "new" / "visits.png", replica=1)
    picture = (imread(path)[..., :3] * 255).round()
    for agent, colour in ((0, (86, 180, 233)), (1, (230, 97, 0))):
        assert (np.abs(picture - colour).max(-1) < 2).sum() > 1000, f"agent {agent} in its hue"
    with pytest.raises(FileExistsError, match=r"visits\.png exists and is not overwritten"):
        draw_visits(found, path)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"replica": 2}, "replica is 2"),
        ({"policy": "greedy"}, "policy is 'greedy'"),
        ({"path": "visits.pdf"}, "path is '.*visits.pdf'"),
    ],
)
def test_what_cannot_be_drawn_is_refused(more, message, corridors, tmp_path):
    found = territory_of(corridors["greedy"], episodes=1)
    with pytest.raises(ValueError, match=message):
        draw_visits(found, **{"path": tmp_path / "visits.png", **more})
    assert not list(tmp_path.iterdir())
