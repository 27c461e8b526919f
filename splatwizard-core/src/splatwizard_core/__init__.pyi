from splatwizard_core.steps import decode as decode
from splatwizard_core.steps import encode as encode
from splatwizard_core.steps import evaluate as evaluate
from splatwizard_core.steps import load_scene as load_scene
from splatwizard_core.steps import render as render
from splatwizard_core.steps import run as run
from splatwizard_core.steps import train as train

__version__: str
