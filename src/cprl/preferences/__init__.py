"""What agents want: the reward that an agent learns from, out of the rewards of everybody.

Modules, in the order in which one reads them:
    values           InequityAversion, SocialValueOrientation, Exchange: frozen values of a recipe
    wanted           wanted_rewards, a pure function; WantedRewards, which holds its memory
    transform        PreferenceTransform, for TorchRL programs of one's own
    wrapper          PreferenceWrapper, for PettingZoo
"""

from cprl.preferences.transform import PreferenceTransform
from cprl.preferences.values import Exchange, InequityAversion, Preference, SocialValueOrientation
from cprl.preferences.wanted import WantedRewards, wanted_rewards
from cprl.preferences.wrapper import PreferenceWrapper

__all__ = [
    "Exchange",
    "InequityAversion",
    "Preference",
    "PreferenceTransform",
    "PreferenceWrapper",
    "SocialValueOrientation",
    "WantedRewards",
    "wanted_rewards",
]
