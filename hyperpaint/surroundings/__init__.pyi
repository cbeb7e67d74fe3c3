from .corrections import (
    correct_coat as correct_coat,
    correct_light as correct_light,
    remove_mirrored_sky as remove_mirrored_sky,
)
from .model import SceneModel as SceneModel
from .surveying import flag as flag, survey as survey
