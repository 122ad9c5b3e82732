"""What a training image shows of the surfaces of rays, compiled: ``details.cpp``."""

from __future__ import annotations

import torch
from torch import Tensor

from mmpi_ns.ops.build import call_in_parts
from mmpi_ns.ops.details import SeenDetails
from mmpi_ns.ops.layout import shaped


def seen_details(origins: Tensor, directions: Tensor, inverse: Tensor, image: Tensor, camera: Tensor) -> SeenDetails:
    rays, (height, width) = len(origins), image.shape[:2]
    arrays = shaped(origins, rays, 3), shaped(directions, rays, 3), shaped(inverse, rays, 1)
    view = shaped(image, height, width, 4), shaped(camera, 24)
    seen = SeenDetails(torch.empty(rays, 3), torch.empty(rays, 1))
    call_in_parts("mmpi_seen_details", rays, (*arrays, *view), (height, width, *seen))
    return seen
