"""Closed-form maps from four stretches to a landing, whose inverses planners must find."""

from __future__ import annotations

import torch
from torch import Tensor


def throw(stretches: Tensor) -> Tensor:
    """Ballistic throw: two numbers steer speed and elevation, two the azimuth; as an ensemble of one, (1, n, 2) [m]."""
    speed = 1.0 + 2.0 * stretches[:, 0]
    elevation = 0.4 + stretches[:, 1]
    azimuth = 6.0 * (stretches[:, 2] - stretches[:, 3])
    distance = speed**2 * torch.sin(2 * elevation) / 9.81
    return torch.stack([distance * torch.cos(azimuth), distance * torch.sin(azimuth)], dim=-1)[None]


def arm(stretches: Tensor) -> Tensor:
    """Planar arm of four links: the angles add up; (1, n, 2) [m]."""
    angles = torch.cumsum(4.0 * (stretches - 0.5), dim=1)
    return 0.25 * torch.stack([torch.cos(angles).sum(dim=1), torch.sin(angles).sum(dim=1)], dim=-1)[None]
