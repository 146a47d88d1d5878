"""The network of the paper: a fully convolutional DenseNet that gives each pixel a probability a class.

Densely connected blocks are of Huang et al. 2016 (the paper's reference); the way down and up again with skip
connections is of Jégou et al. 2017, "The One Hundred Layers Tiramisu". Importing this needs PyTorch.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from valuemap.config import TrainConfig


class DenseLayer(nn.Module):
    """Batch norm, ReLU, 3x3 convolution, dropout: `growth` new channels from all channels so far."""

    def __init__(self, channels: int, growth: int, dropout: float) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(channels)
        self.conv = nn.Conv2d(channels, growth, 3, padding=1, bias=False)
        self.dropout = nn.Dropout2d(dropout)

    def forward(self, x: Tensor) -> Tensor:
        """Return (batch, growth, height, width)."""
        new: Tensor = self.dropout(self.conv(functional.relu(self.norm(x))))
        return new


class DenseBlock(nn.Module):
    """Layers that each see the block's input and all earlier layers; returns the new channels only."""

    def __init__(self, channels: int, layers: int, growth: int, dropout: float) -> None:
        super().__init__()
        self.layers = nn.ModuleList(DenseLayer(channels + i * growth, growth, dropout) for i in range(layers))
        self.new_channels = layers * growth

    def forward(self, x: Tensor) -> Tensor:
        """Return (batch, layers * growth, height, width)."""
        new: list[Tensor] = []
        for layer in self.layers:
            new.append(layer(torch.cat([x, *new], dim=1)))
        return torch.cat(new, dim=1)


class TransitionDown(nn.Module):
    """Batch norm, ReLU, 1x1 convolution, dropout, 2x2 max pooling: half the size, fewer channels."""

    def __init__(self, channels: int, out_channels: int, dropout: float) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(channels)
        self.conv = nn.Conv2d(channels, out_channels, 1, bias=False)
        self.dropout = nn.Dropout2d(dropout)

    def forward(self, x: Tensor) -> Tensor:
        """Return (batch, out_channels, height / 2, width / 2)."""
        return functional.max_pool2d(self.dropout(self.conv(functional.relu(self.norm(x)))), 2)


class FCDenseNet(nn.Module):
    """Pictures (batch, 3, height, width), normalised, to logits (batch, classes, height, width).

    Height and width are multiples of 32: the default network halves them five times. The first convolution halves
    the picture already where `first_stride` is 2; the logits are then enlarged again, which costs little and keeps
    small objects.
    """

    def __init__(self, classes: int, config: TrainConfig) -> None:
        super().__init__()
        growth, dropout = config.growth_channels, config.dropout
        self.first_stride = config.first_stride
        self.first = nn.Conv2d(3, config.first_channels, 3, stride=config.first_stride, padding=1, bias=False)
        layers = [config.first_layers, *[config.layers] * config.levels]

        channels = config.first_channels
        skip_channels: list[int] = []
        self.down_blocks, self.downs = nn.ModuleList(), nn.ModuleList()
        for count in layers[:-1]:
            block = DenseBlock(channels, count, growth, dropout)
            channels += block.new_channels
            skip_channels.append(channels)
            kept = max(1, round(config.compression * channels))
            self.down_blocks.append(block)
            self.downs.append(TransitionDown(channels, kept, dropout))
            channels = kept

        self.bottleneck = DenseBlock(channels, layers[-1], growth, dropout)
        new_channels = self.bottleneck.new_channels
        self.ups, self.up_blocks = nn.ModuleList(), nn.ModuleList()
        for count, skip in zip(layers[-2::-1], skip_channels[::-1], strict=True):
            self.ups.append(nn.ConvTranspose2d(new_channels, count * growth, 2, stride=2))
            block = DenseBlock(count * growth + skip, count, growth, dropout)
            self.up_blocks.append(block)
            channels, new_channels = count * growth + skip + block.new_channels, block.new_channels

        self.norm = nn.BatchNorm2d(channels)
        self.last = nn.Conv2d(channels, classes, 1)
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
        # Objects are rare: begin with the probability that says so, or the background swamps the first steps.
        nn.init.normal_(self.last.weight, std=0.01)
        nn.init.constant_(self.last.bias, -math.log(99.0))

    def forward(self, pictures: Tensor) -> Tensor:
        """Return the logits."""
        x = self.first(pictures)
        skips: list[Tensor] = []
        for block, down in zip(self.down_blocks, self.downs, strict=True):
            x = torch.cat([x, block(x)], dim=1)
            skips.append(x)
            x = down(x)
        new = self.bottleneck(x)
        for up, block in zip(self.ups, self.up_blocks, strict=True):
            x = torch.cat([up(new), skips.pop()], dim=1)
            new = block(x)
        logits: Tensor = self.last(functional.relu(self.norm(torch.cat([x, new], dim=1))))
        if self.first_stride == 1:
            return logits
        return functional.interpolate(logits, scale_factor=float(self.first_stride), mode="bilinear")
