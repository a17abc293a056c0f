"""Skills of the scripted expert: approach, grasp, lift, carry, place, pull, push, turn; over all rows at once."""

from worldenv_trl.scenes.skills.phase import CLOSE, OPEN, Phase, body, tcp
from worldenv_trl.scenes.skills.pick import pick_and_place
from worldenv_trl.scenes.skills.push import push_to
from worldenv_trl.scenes.skills.turn import pull_open, push_closed, turn

__all__ = ["CLOSE", "OPEN", "Phase", "body", "pick_and_place", "pull_open", "push_closed", "push_to", "tcp", "turn"]
