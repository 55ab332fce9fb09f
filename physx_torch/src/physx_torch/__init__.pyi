"""The physx plugin ``torch``: PyTorch networks, optimization and transformation."""

from .actuator import LearnedActuator as LearnedActuator
from .actuator import learn_actuator as learn_actuator
from .forward_dynamics import ForwardDynamics as ForwardDynamics
from .networks.encoder_decoder import EncoderDecoder as EncoderDecoder
from .networks.fc import FC as FC
from .networks.module_network import ModuleNetwork as ModuleNetwork
from .networks.network import TorchNetwork as TorchNetwork
from .networks.transformation import TorchTransformation as TorchTransformation
from .networks.unet import UNet as UNet
from .networks.unet_transformation import UNetTransformation as UNetTransformation
from .step import Step as Step
from .training.data import StoredDataset as StoredDataset
from .training.optimization import TorchOptimization as TorchOptimization
from .training.tensorboard import TensorBoard as TensorBoard
from .training.wandb import WandB as WandB
from .version import __version__ as __version__
