from .drivers import open_device as open_device
from .drivers import separate_devices as separate_devices
from .engine.camera import Camera as Camera
from .errors import UserError as UserError
from .evaluate import evaluate_run as evaluate_run
from .files.rendered_view import RenderedView as RenderedView
from .files.run_folder import RunFolder as RunFolder
from .progress import Progress as Progress
from .progress import track as track
from .run import Run as Run
from .run import find_run as find_run
from .run import load as load
from .run import stored_config as stored_config
from .scene.load import Scene as Scene
from .scene.load import load_scene as load_scene
from .session.training import OnStep as OnStep
from .session.training import Training as Training
from .session.training import train_scene as train_scene
from .settings import Config as Config

__version__: str
