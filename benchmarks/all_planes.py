"""The plain way to render: all K x L planes of a field for every ray. What speed is measured against."""

from __future__ import annotations

import torch
from nerfstudio.cameras.rays import RayBundle
from plane_crossings import crossings
from torch import Tensor, nn

from mmpi_ns.bench.trainers import Steps, clock
from mmpi_ns.field.mmpi_field import MMPIField
from mmpi_ns.field.shading import ColorNetworks
from mmpi_ns.ops.composite import composite_weights, render_colors
from mmpi_ns.ops.interpolate import interpolate_densely
from mmpi_ns.ops.shade import head_colors
from mmpi_ns.rendering.rendered import bounded
from mmpi_ns.scene.geometry import plane_hits


def render_densely(field: MMPIField, bundle: RayBundle) -> tuple[Tensor, float]:
    """Every plane of every MPI for every ray, one sort, colours wherever alpha exceeds 1e-4, dense gradients.

    Returns:
        Colours over grey [R, 3], and samples a ray.
    """
    assert bundle.nears is not None and bundle.fars is not None
    hits = plane_hits(bundle.origins, bundle.directions, bundle.nears, bundle.fars, field.layout.frames)
    taus, keys, colors = [], [], []
    assert isinstance(field.networks, ColorNetworks)
    count, networks = len(bundle), field.networks.of_heads(range(len(field.plan.mpis)))
    for k, mpi in enumerate(field.plan.mpis):
        live, u, v, inverse_t = crossings(hits, field.layout.frames, k, mpi.planes)
        planes, (u0, u1, v0, v1) = torch.arange(mpi.planes).expand(count, -1), mpi.extent
        ndc = (2 * (u - u0) / (u1 - u0) - 1, 2 * (v - v0) / (v1 - v0) - 1, 2 * planes / (mpi.planes - 1) - 1)
        ndc, planes = torch.stack(ndc, -1).reshape(-1, 3), planes.reshape(-1)
        rows, weights = field.grids[k].bilinear(planes, ndc)
        raw = interpolate_densely(field.density, rows, weights)[:, 0]
        tau = torch.where(live.reshape(-1), field.layout.optical_depth(k, raw, planes), 0.0)
        chosen = (tau > 1e-4).nonzero()[:, 0]
        features = interpolate_densely(field.features, rows[chosen], weights[chosen])
        color = head_colors(networks, k, features, ndc[chosen], hits.local_directions[:, k], chosen // mpi.planes)
        colors.append(torch.zeros(tau.shape[0], 3).index_put((chosen,), color).view(count, -1, 3))
        taus.append(tau.view(count, -1))
        keys.append(torch.where(live, inverse_t, -1.0))
    order = torch.sort(torch.cat(keys, -1), dim=-1, descending=True, stable=True)[1]
    tau = torch.cat(taus, -1).gather(-1, order)
    color = torch.cat(colors, 1).gather(1, order[..., None].expand(-1, -1, 3))
    zero = torch.zeros_like(tau)
    result = composite_weights.reference(tau, tau > 0, zero, zero[:, :1])
    return render_colors(result, color) + 0.5 * result.transmittance, float(tau.shape[1])


def rates_of(field: MMPIField) -> list[dict]:
    """Optimiser groups of a field that is trained without reliability."""
    rates = {field.density: 0.1, field.features: 0.1, field.networks.weights: 1e-3}
    return [{"params": [p], "lr": lr} for p, lr in rates.items()]


class DenseSteps:
    """Training by it like ours, on the same plan at all its texels, with the same batches: photometric loss, plain
    Adam."""

    def __init__(self, like: Steps) -> None:
        self.like, self.model, self.step, self.samples = like, like.pipeline.model, 0, 0.0
        names = ("feature_channels", "hidden_width")
        settings = {name: getattr(self.model.config.colour, name) for name in names}
        self.field = MMPIField(self.model.field.full_plan, **settings, shares_depth=True).to(self.model.device)
        for name in ("density", "features"):  # all rows have gradients here, so tables are plain parameters
            self.field.register_parameter(name, nn.Parameter(getattr(self.field, name).data))
        self.optimizer = torch.optim.Adam(rates_of(self.field), betas=(0.9, 0.99))

    def run(self, count: int) -> float:
        """Trains; returns seconds."""
        start = clock()
        for step in range(self.step, self.step + count):
            bundle, batch = self.like.pipeline.datamanager.next_train(step)
            image = batch["image"].to(self.model.device)
            n = len(image)  # rays to keypoints come last
            bundle = RayBundle(bundle.origins[:n], bundle.directions[:n], bundle.pixel_area[:n])
            rgb, self.samples = render_densely(self.field, bounded(bundle, self.field.plan))
            self.optimizer.zero_grad()
            ((rgb - image[:, :3]) ** 2).mean().backward()
            self.optimizer.step()
        self.step += count
        return clock() - start
