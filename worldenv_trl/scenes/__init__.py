"""What the world is made of: robot, objects, tasks, predicates, simulation, expert. NumPy and MuJoCo only."""

from worldenv_trl.scenes.rendering import RendererPool  # first: where GL is missing, this says what to install

# isort: split
from worldenv_trl.scenes.catalogue import list_suites, list_tasks, load_task
from worldenv_trl.scenes.coverage import goal_places, layout_distances, spread_states, usual_states
from worldenv_trl.scenes.expert import ScriptedExpert
from worldenv_trl.scenes.perturbed import PerturbedExpert
from worldenv_trl.scenes.simulation import SceneBatch
from worldenv_trl.scenes.tasks import Task

__all__ = [
    "PerturbedExpert",
    "RendererPool",
    "SceneBatch",
    "ScriptedExpert",
    "Task",
    "goal_places",
    "layout_distances",
    "list_suites",
    "list_tasks",
    "load_task",
    "spread_states",
    "usual_states",
]
