"""Networks, optimizations and transformations of which each has one mistake, and right ones."""

import contextlib
import pickle

import numpy as np

from physx_core import Network, Optimization, Transformation
from physx_core.errors import CheckpointError


class Right(Network):
    """A layer of tanh and a linear one, in NumPy."""

    net_fields, opt_fields, pred_fields = ("x",), ("y",), ("y",)
    seed = 0

    @classmethod
    def set_seed(cls, seed):
        Right.seed = seed

    def __init__(self):
        self.random = np.random.default_rng(Right.seed)
        self.first = self.last = np.zeros((0, 0))
        self.training = True

    def bind(self, fields):
        super().bind(fields)
        self.shape = fields["y"].shape
        sizes = (int(np.prod(fields["x"].shape)), 16, int(np.prod(self.shape)))
        self.first = self.random.standard_normal(sizes[:2]) / np.sqrt(sizes[0])
        self.last = self.random.standard_normal(sizes[1:]) / 4

    def set_train(self):
        self.training = True

    def set_eval(self):
        self.training = False

    def hidden(self, data):
        return np.tanh(data["x"].reshape(len(data["x"]), -1) @ self.first)

    def predict(self, data):
        return {"y": (self.hidden(data) @ self.last).reshape(-1, *self.shape)}

    def get_parameters(self):
        return {"first": self.first, "last": self.last}


class OtherName(Right):
    def predict(self, data):
        return {"z": super().predict(data)["y"]}


class ReturnsNothing(Right):
    def predict(self, data):
        super().predict(data)


class TakesNothing(Right):
    def predict(self):
        return {}


class FlatPrediction(Right):
    def predict(self, data):
        return {"y": super().predict(data)["y"].sum(axis=-1)}


class MixesRows(Right):
    def predict(self, data):
        found = super().predict(data)["y"]
        return {"y": found - found.mean(axis=0)}


class DropsInEvaluation(Right):
    def predict(self, data):
        found = super().predict(data)["y"]
        return {"y": found * (self.random.random(found.shape) > 0.2)}


class ChangesInputs(Right):
    def predict(self, data):
        data["x"] *= 2.0
        return super().predict(data)


class IgnoresSeed(Right):
    def __init__(self):
        super().__init__()
        self.random = np.random.default_rng()


class Pickles(Right):
    def save_parameters(self, path):
        path.write_bytes(pickle.dumps([self.first, self.last]))

    def load_parameters(self, path):
        try:
            self.first, self.last = pickle.loads(path.read_bytes())  # noqa: S301 - the mistake
        except Exception as error:
            raise CheckpointError(str(error)) from error


class ForgetsOffset(Right):
    def bind(self, fields):
        super().bind(fields)
        self.offset = self.random.standard_normal(self.shape)

    def predict(self, data):
        return {"y": super().predict(data)["y"] + self.offset}


class LoadsAnything(Right):
    def load_parameters(self, path):
        with contextlib.suppress(CheckpointError):
            super().load_parameters(path)


class BindsAnything(Right):
    def bind(self, fields):
        if "x" in fields:
            super().bind(fields)


class Swallows(Right):
    def __init__(self, **kwargs):
        super().__init__()


class Descends(Optimization):
    """Gradient descent of the last layer, with a momentum that it saves."""

    state_file = "momentum.npz"
    rate = 0.1

    def set_optimizer(self, optimizer, network, **kwargs):
        super().set_optimizer(optimizer, network, **kwargs)
        self.momentum = np.zeros(())

    def compute_loss(self, batch):
        error = batch.prediction["y"] - batch.targets["y"]
        error = error.reshape(len(error), -1)
        self.gradient = 2 * self.network.hidden(batch.data).T @ error / error.size
        return float(np.mean(error**2))

    def compute_row_losses(self, batch):
        error = batch.prediction["y"] - batch.targets["y"]
        return np.mean(error.reshape(len(error), -1) ** 2, axis=1)

    def optimize(self, loss):
        self.momentum = 0.5 * self.momentum + self.gradient
        self.network.last -= self.rate * self.momentum

    def save_state(self, path):
        with path.open("wb") as file:
            np.savez(file, momentum=self.momentum)

    def load_state(self, path):
        self.momentum = np.load(path)["momentum"]


class Climbs(Descends):
    rate = -0.1


class StepsInLoss(Descends):
    def compute_loss(self, batch):
        loss = super().compute_loss(batch)
        self.network.last -= 0.01 * self.gradient
        return loss


class ForgetsMomentum(Descends):
    state_file = ""


class RowLossesStep(Descends):
    def compute_row_losses(self, batch):
        self.gradient = 2 * self.gradient
        return super().compute_row_losses(batch)


class Noisy(Descends):
    def optimize(self, loss):
        self.gradient = self.gradient + np.random.default_rng().standard_normal(self.gradient.shape)
        super().optimize(loss)


class HidesNaN(Descends):
    def compute_loss(self, batch):
        loss = super().compute_loss(batch)
        self.gradient = np.nan_to_num(self.gradient)
        return float(np.nan_to_num(loss))


class Scales(Transformation):
    """Normalizes inputs and targets."""

    def __init__(self):
        super().__init__()
        self.known = {}

    def set_normalization(self, normalization, network):
        super().set_normalization(normalization, network)
        self.known = dict(normalization)
        self.pairs = list(zip(network.pred_fields, network.opt_fields, strict=True))

    def scaled(self, data):
        known = self.known
        return {
            name: (values - known[name].mean) / known[name].std if name in known else values
            for name, values in data.items()
        }

    def transform_before_prediction(self, data):
        return self.scaled(data)

    def transform_before_loss(self, prediction, targets):
        return prediction, self.scaled(targets)

    def transform_before_apply(self, prediction):
        found = dict(prediction)
        for pred, opt in self.pairs:
            if opt in self.known:
                item = self.known[opt]
                found[pred] = prediction[pred] * item.std + item.mean
        return found


class ForgetsToUndo(Scales):
    def transform_before_apply(self, prediction):
        return prediction


class UndoesAlways(Scales):
    def transform_before_apply(self, prediction):
        return {
            name: values * 2 for name, values in super().transform_before_apply(prediction).items()
        }


class KeepsNothing(Scales):
    def set_normalization(self, normalization, network):
        super().set_normalization(normalization, network)
        self.normalization = {}


class InPlace(Scales):
    def transform_before_loss(self, prediction, targets):
        for name, values in targets.items():
            if name in self.known:
                values -= self.known[name].mean
                values /= self.known[name].std
        return prediction, targets


class OfTheBatch(Scales):
    def transform_before_prediction(self, data):
        return {name: values - values.mean(axis=0) for name, values in data.items()}
