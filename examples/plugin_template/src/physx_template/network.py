import torch

from physx_torch import TorchNetwork


class MLP(TorchNetwork):
    def __init__(self, points=10, width=32, net_fields="cloud", opt_fields="mean"):
        super().__init__(net_fields=net_fields, opt_fields=opt_fields)
        first, last = torch.nn.Linear(3 * points, width), torch.nn.Linear(width, 3)
        self.layers = torch.nn.Sequential(torch.nn.Flatten(), first, torch.nn.ReLU(), last)

    def forward(self, cloud):
        return self.layers(cloud)
