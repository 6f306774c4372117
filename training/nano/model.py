"""The any-view network of Depth Anything 3: alternating attention, cameras in and out, depth and rays.

Written from the paper's description; the names of the parameters are those of the official checkpoints, so that the
exported file is loaded by the same code. `B` scenes of `S` views; `n` patches and `N = n + 1` tokens per view.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .config import HEAD_LAST, PATCH, POSITION_GRID, NanoConfig
from .geometry import matrix_from_quaternion


@dataclass
class Output:
    """What the network says. Views are in the order of the input.

    depth, depth_conf [B, S, H, W]; ray [B, S, 6, 8ph, 8pw], ray_conf [B, S, 8ph, 8pw] or None; pose_enc [B, S, 9].
    logits: of the blocks that are watched, by block [B, heads, S N, S N]; only where the order of views was kept.
    patches: the third of the four features [B, S, n, 2 dim].
    """

    depth: Tensor
    depth_conf: Tensor
    log_depth: Tensor
    ray: Tensor | None
    ray_conf: Tensor | None
    pose_enc: Tensor
    reference: Tensor
    logits: dict[int, Tensor] = field(default_factory=dict)
    patches: Tensor | None = None

    def world_from_camera(self) -> Tensor:
        """[B, S, 3, 4] in the gauge of the depth."""
        rotation = matrix_from_quaternion(self.pose_enc[..., 3:7])
        return torch.cat([rotation, self.pose_enc[..., :3, None]], -1)


class LayerScale(nn.Module):
    """A factor per channel."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(dim))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gamma


class Mlp(nn.Module):
    """Two linear maps with a GELU between them."""

    def __init__(self, dim: int, hidden: int, out: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, hidden)
        self.fc2 = nn.Linear(hidden, out)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


class Attention(nn.Module):
    """Self-attention over the second axis of [batch, tokens, dim]."""

    def __init__(self, dim: int, heads: int, qk_norm: bool) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)
        if qk_norm:
            self.q_norm = nn.LayerNorm(dim // heads, eps=1e-5)
            self.k_norm = nn.LayerNorm(dim // heads, eps=1e-5)
        self.qk_norm = qk_norm
        # Training looks at the logits of some blocks (`losses.match_terms`).
        self.is_watched = False
        self.logits: Tensor | None = None

    def forward(self, x: Tensor, rope: tuple[Tensor, Tensor] | None) -> Tensor:
        batch, tokens, dim = x.shape
        q, k, v = self.qkv(x).view(batch, tokens, 3, self.heads, dim // self.heads).unbind(2)
        if self.qk_norm:
            q, k = self.q_norm(q), self.k_norm(k)
        if rope is not None:
            q, k = rotate(q, *rope), rotate(k, *rope)
        q, k, v = (t.to(v.dtype).transpose(1, 2) for t in (q, k, v))
        self.logits = None
        if x.is_cuda and not self.is_watched:
            mixed = F.scaled_dot_product_attention(q, k, v)
        else:
            # On a CPU and for few tokens this is several times faster than `scaled_dot_product_attention`.
            logits = (q * q.shape[-1] ** -0.5) @ k.transpose(-1, -2)
            if self.is_watched:
                self.logits = logits
            mixed = torch.softmax(logits, -1).to(v.dtype) @ v
        return self.proj(mixed.transpose(1, 2).reshape(batch, tokens, dim))


class Block(nn.Module):
    """Pre-norm transformer block with layer scale."""

    def __init__(self, dim: int, heads: int, ratio: int, eps: float, qk_norm: bool) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=eps)
        self.attn = Attention(dim, heads, qk_norm)
        self.ls1 = LayerScale(dim)
        self.norm2 = nn.LayerNorm(dim, eps=eps)
        self.mlp = Mlp(dim, ratio * dim, dim)
        self.ls2 = LayerScale(dim)

    def forward(self, x: Tensor, rope: tuple[Tensor, Tensor] | None = None) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x), rope))
        return x + self.ls2(self.mlp(self.norm2(x)))


def rope_tables(positions: Tensor, head_dim: int) -> tuple[Tensor, Tensor]:
    """Cosines and sines [tokens, 1, head_dim] of row-column positions [tokens, 2]; base 100."""
    half = head_dim // 2
    rates = 100.0 ** (-torch.arange(half // 2, dtype=torch.float32, device=positions.device) * 2 / half)
    angles = [positions[:, k : k + 1] * rates for k in (0, 1)]
    full = torch.cat([angles[0], angles[0], angles[1], angles[1]], -1)[:, None]
    return full.cos(), full.sin()


def rotate(x: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Rotates [..., tokens, heads, head_dim] by position."""
    a, b, c, d = x.chunk(4, -1)
    return x * cosine + torch.cat([-b, a, -d, c], -1) * sine


class PatchEmbed(nn.Module):
    """14 x 14 patches to tokens."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, dim, PATCH, PATCH)

    def forward(self, x: Tensor) -> Tensor:
        """[V, 3, H, W] -> [V, n, dim]; a convolution without overlap is one matrix product."""
        views, _, height, width = x.shape
        rows, columns = height // PATCH, width // PATCH
        x = x.reshape(views, 3, rows, PATCH, columns, PATCH).permute(0, 2, 4, 1, 3, 5)
        return F.linear(x.reshape(views, rows * columns, -1), self.proj.weight.flatten(1), self.proj.bias)


def enlarged(grid: Tensor) -> Tensor:
    """[k, c, g, g] -> [k, c, 37, 37]."""
    size = (POSITION_GRID, POSITION_GRID)
    return F.interpolate(grid, size, mode="bicubic", align_corners=True)


def resized(grid: Tensor, rows: int, columns: int) -> Tensor:
    """[k, c, 37, 37] -> [k, c, rows, columns] as inference resizes it; the 0.1 is part of the architecture."""
    if rows == columns == POSITION_GRID:
        return grid
    factors = ((rows + 0.1) / POSITION_GRID, (columns + 0.1) / POSITION_GRID)
    return F.interpolate(grid, scale_factor=factors, mode="bicubic", align_corners=False)


@lru_cache(maxsize=64)
def position_operator(trained: int, rows: int, columns: int) -> Tensor:
    """[trained^2, rows * columns]: both resizings are linear, so that they are one matrix, found from unit grids."""
    grid = enlarged(torch.eye(trained * trained).view(-1, 1, trained, trained))
    return resized(grid, rows, columns).flatten(1)


class Backbone(nn.Module):
    """The vision transformer with alternating local and global attention."""

    def __init__(self, config: NanoConfig) -> None:
        super().__init__()
        self.config = config
        dim = config.dim
        self.patch_embed = PatchEmbed(dim)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, dim))
        self.camera_token = nn.Parameter(torch.zeros(1, 2, dim))
        # Exported as one `pos_embed` of 1 + 37 x 37 rows.
        self.pos_special = nn.Parameter(torch.zeros(1, 1, dim))
        self.pos_grid = nn.Parameter(torch.zeros(1, dim, config.trained_grid, config.trained_grid))
        # The exported grid itself [1, dim, 37, 37], where a network was read from a file.
        self.pos_full: Tensor | None = None
        self.blocks = nn.ModuleList(
            Block(dim, config.heads, 4, 1e-6, i >= config.qknorm_start) for i in range(config.depth)
        )
        self.norm = nn.LayerNorm(dim, eps=1e-5)

    def watch(self, blocks: tuple[int, ...]) -> None:
        """Keeps the attention logits of these blocks from now on."""
        for i, block in enumerate(self.blocks):
            block.attn.is_watched = i in blocks

    def watched(self) -> dict[int, Tensor]:
        """Logits of the last run by block."""
        return {i: b.attn.logits for i, b in enumerate(self.blocks) if b.attn.logits is not None}

    def full_grid(self) -> Tensor:
        """[1, dim, 37, 37]."""
        return enlarged(self.pos_grid) if self.pos_full is None else self.pos_full

    def position(self, rows: int, columns: int) -> Tensor:
        """[1, n, dim] for a picture of rows x columns patches: the exported grid, resized as inference does."""
        if self.pos_full is not None:
            return resized(self.pos_full, rows, columns).flatten(2).transpose(1, 2)
        operator = position_operator(self.config.trained_grid, rows, columns).to(self.pos_grid.device)
        return (self.pos_grid.flatten(2)[0] @ operator).T[None]

    def forward(
        self, images: Tensor, camera_tokens: Tensor | None, select: bool
    ) -> tuple[list[tuple[Tensor, Tensor]], Tensor]:
        """[B, S, 3, H, W] and tokens [B, S, dim] or None -> four (patches [B, S, n, 2 dim], camera [B, S, 2 dim]).

        With `select`, three views or more are reordered round the reference that the architecture chooses; else view 0
        is the reference. The second result is that view's index [B].
        """
        config = self.config
        scenes, views, _, height, width = images.shape
        rows, columns = height // PATCH, width // PATCH
        x = self.patch_embed(images.flatten(0, 1)) + self.position(rows, columns)
        special = (self.cls_token + self.pos_special).to(x.dtype).expand(scenes * views, 1, -1)
        x = torch.cat([special, x], 1)
        tokens = x.shape[1]
        local_rope, global_rope = self.ropes(rows, columns, views)
        order = torch.arange(views, device=x.device).expand(scenes, views)
        features, local = [], x
        for i, block in enumerate(self.blocks):
            if i == config.alt_start - 1 and select and views >= 3 and camera_tokens is None:
                order = reference_first(x.view(scenes, views, tokens, -1)[:, :, 0])
                x = pick_views(x.view(scenes, views, tokens, -1), order).flatten(0, 1)
            if i == config.alt_start:
                first = self.special_tokens(camera_tokens, scenes, views)
                x = torch.cat([first.flatten(0, 1)[:, None].to(x.dtype), x[:, 1:]], 1)
            if config.is_global(i):
                rope = global_rope if i >= config.rope_start else None
                x = block(x.view(scenes, views * tokens, -1), rope).view(scenes * views, tokens, -1)
            else:
                x = block(x, local_rope if i >= config.rope_start else None)
                local = x
            if i in config.out_layers:
                features.append(self.feature(local, x, scenes, order))
        return features, order[:, 0]

    def ropes(self, rows: int, columns: int, views: int) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """Tables of local and of global blocks."""
        grid = torch.cartesian_prod(torch.arange(rows), torch.arange(columns)).float() + 1
        local = torch.cat([torch.zeros(1, 2), grid])
        flat = (local > 0).float()
        head_dim, device = self.config.dim // self.config.heads, self.cls_token.device
        local, flat = local.to(device), flat.to(device)
        return rope_tables(local, head_dim), rope_tables(flat.repeat(views, 1), head_dim)

    def special_tokens(self, given: Tensor | None, scenes: int, views: int) -> Tensor:
        """[B, S, dim] that take the place of the class tokens."""
        if given is not None:
            return given
        index = (torch.arange(views) > 0).long()
        return self.camera_token[0, index].expand(scenes, views, -1)

    def feature(self, local: Tensor, x: Tensor, scenes: int, order: Tensor) -> tuple[Tensor, Tensor]:
        views, tokens = order.shape[1], x.shape[1]
        back = order.argsort(1)
        local = pick_views(local.view(scenes, views, tokens, -1), back)
        x = pick_views(x.view(scenes, views, tokens, -1), back)
        camera = torch.cat([local[:, :, 0], x[:, :, 0]], -1)
        return torch.cat([local[:, :, 1:], self.norm(x[:, :, 1:])], -1), camera


def pick_views(x: Tensor, order: Tensor) -> Tensor:
    """[B, S, ...] in another order [B, S] of views."""
    return x[torch.arange(x.shape[0], device=x.device)[:, None], order]


def reference_first(tokens: Tensor) -> Tensor:
    """Order [B, S] with the balanced reference view first; `tokens` [B, S, dim] are the class tokens."""
    tokens = tokens.float()
    size = tokens.norm(dim=-1)
    unit = tokens / size[..., None]
    views = tokens.shape[1]
    similar = (unit @ unit.transpose(1, 2) - torch.eye(views, device=tokens.device)).sum(-1) / (views - 1)

    def balance(value: Tensor) -> Tensor:
        low, high = value.amin(1, keepdim=True), value.amax(1, keepdim=True)
        return ((value - low) / (high - low + 1e-8) - 0.5).abs()

    reference = (balance(similar) + balance(size) + balance(unit.var(-1))).argmin(1)
    index = torch.arange(views, device=tokens.device).expand(tokens.shape[0], views)
    key = torch.where(index == reference[:, None], -1, index)
    return key.argsort(1)


class CameraEncoder(nn.Module):
    """Given cameras to one token per view."""

    def __init__(self, config: NanoConfig) -> None:
        super().__init__()
        dim = config.dim
        self.pose_branch = Mlp(9, dim // 2, dim)
        self.token_norm = nn.LayerNorm(dim, eps=1e-5)
        self.trunk = nn.Sequential(
            *(Block(dim, config.cam_enc_heads, config.cam_enc_ratio, 1e-5, False) for _ in range(config.cam_enc_depth))
        )
        self.trunk_norm = nn.LayerNorm(dim, eps=1e-5)

    def forward(self, pose9: Tensor) -> Tensor:
        """[B, S, 9] -> [B, S, dim]."""
        return self.trunk_norm(self.trunk(self.token_norm(self.pose_branch(pose9))))


class CameraDecoder(nn.Module):
    """The last camera token to a pose vector: translation, xyzw, fields of view."""

    def __init__(self, config: NanoConfig) -> None:
        super().__init__()
        width = 2 * config.dim
        self.backbone = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.fc_t = nn.Linear(width, 3)
        self.fc_qvec = nn.Linear(width, 4)
        self.fc_fov = nn.Sequential(nn.Linear(width, 2), nn.ReLU())

    def forward(self, token: Tensor) -> Tensor:
        """[B, S, 2 dim] -> [B, S, 9]."""
        hidden = self.backbone(token)
        return torch.cat([self.fc_t(hidden), self.fc_qvec(hidden), self.fc_fov(hidden)], -1)


class ResidualUnit(nn.Module):
    """x + conv(relu(conv(relu(x))))."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(features, features, 3, padding=1)
        self.conv2 = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv2(F.relu(self.conv1(F.relu(x))))


class Fusion(nn.Module):
    """Adds a finer map, refines, enlarges."""

    def __init__(self, features: int, lateral: bool) -> None:
        super().__init__()
        if lateral:
            self.resConfUnit1 = ResidualUnit(features)
        self.resConfUnit2 = ResidualUnit(features)
        self.out_conv = nn.Conv2d(features, features, 1)

    def forward(self, x: Tensor, lateral: Tensor | None, size: tuple[int, int]) -> Tensor:
        if lateral is not None:
            x = x + self.resConfUnit1(lateral)
        # A 1 x 1 convolution and a bilinear enlargement may change places: the weights of the latter sum to one.
        x = self.out_conv(self.resConfUnit2(x))
        return F.interpolate(x, size, mode="bilinear", align_corners=True)


class ChannelNorm(nn.LayerNorm):
    """Layer norm over the channels of [V, C, h, w]."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class Scratch(nn.Module):
    """The fusion chains and the last convolutions; only what inference uses of the auxiliary levels."""

    def __init__(self, config: NanoConfig) -> None:
        super().__init__()
        f, half = config.features, config.features // 2
        for k, channels in enumerate(config.out_channels):
            setattr(self, f"layer{k + 1}_rn", nn.Conv2d(channels, f, 3, padding=1, bias=False))
            setattr(self, f"refinenet{k + 1}", Fusion(f, k < 3))
            setattr(self, f"refinenet{k + 1}_aux", Fusion(f, k < 3))
        self.output_conv1 = nn.Conv2d(f, half, 3, padding=1)
        self.output_conv2 = last_convolutions(half, 2)
        widths = [f, half, f, half, f, half]
        chain = [nn.Conv2d(a, b, 3, padding=1) for a, b in zip(widths, widths[1:], strict=False)]
        self.output_conv1_aux = nn.ModuleDict({"3": nn.Sequential(*chain)})
        self.output_conv2_aux = nn.ModuleDict(
            {
                "3": nn.ModuleDict({"0": nn.Conv2d(half, HEAD_LAST, 3, padding=1), "5": nn.Conv2d(HEAD_LAST, 7, 1)}),
                # The norm is shared by all levels and stored under the first.
                "0": nn.ModuleDict({"2": ChannelNorm(HEAD_LAST, eps=1e-5)}),
            }
        )


def last_convolutions(width: int, out: int) -> nn.Sequential:
    """3 x 3, relu, 1 x 1."""
    return nn.Sequential(nn.Conv2d(width, HEAD_LAST, 3, padding=1), nn.ReLU(), nn.Conv2d(HEAD_LAST, out, 1))


_UV: dict[tuple, Tensor] = {}


def uv_embedding(channels: int, rows: int, columns: int, aspect: float) -> Tensor:
    """[1, channels, rows, columns]: sines and cosines of the place in the image, times 0.1."""
    key = (channels, rows, columns, aspect)
    if key not in _UV:
        diagonal = math.sqrt(aspect * aspect + 1)
        limit_u = aspect / diagonal * (columns - 1) / columns
        limit_v = 1 / diagonal * (rows - 1) / rows
        u = torch.linspace(-limit_u, limit_u, columns)
        v = torch.linspace(-limit_v, limit_v, rows)
        quarter = channels // 4
        rates = 100.0 ** (-torch.arange(quarter, dtype=torch.float32) / quarter)
        along_u = (rates[:, None] * u)[:, None].expand(quarter, rows, columns)
        along_v = (rates[:, None] * v)[:, :, None].expand(quarter, rows, columns)
        _UV[key] = 0.1 * torch.cat([along_u.sin(), along_u.cos(), along_v.sin(), along_v.cos()])[None]
    return _UV[key]


class DualDpt(nn.Module):
    """Four features to dense depth and rays."""

    def __init__(self, config: NanoConfig) -> None:
        super().__init__()
        width, channels = 2 * config.dim, config.out_channels
        self.norm = nn.LayerNorm(width, eps=1e-5)
        self.projects = nn.ModuleList(nn.Conv2d(width, c, 1) for c in channels)
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(channels[0], channels[0], 4, 4),
                nn.ConvTranspose2d(channels[1], channels[1], 2, 2),
                nn.Identity(),
                nn.Conv2d(channels[3], channels[3], 3, 2, 1),
            ]
        )
        self.scratch = Scratch(config)

    def forward(
        self, features: list[Tensor], height: int, width: int, wants_rays: bool
    ) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
        """Features [V, n, 2 dim] -> log depth, log (conf - 1) [V, H, W], rays [V, 6, 8ph, 8pw], log (ray conf - 1)."""
        rows, columns = height // PATCH, width // PATCH
        aspect = width / height
        levels = [self.stage(k, f, rows, columns, aspect) for k, f in enumerate(features)]
        fine = (8 * rows, 8 * columns)
        s = self.scratch
        main = s.output_conv1(self.chain(levels, fine, ""))
        main = F.interpolate(main, (height, width), mode="bilinear", align_corners=True)
        main = s.output_conv2(main + uv_embedding(main.shape[1], height, width, aspect).to(main.device)).float()
        if not wants_rays:
            return main[:, 0], main[:, 1], None, None
        aux = s.output_conv1_aux["3"](self.chain(levels, fine, "_aux"))
        last = s.output_conv2_aux["3"]
        aux = last["0"](aux + uv_embedding(aux.shape[1], *fine, aspect).to(aux.device))
        aux = last["5"](F.relu(s.output_conv2_aux["0"]["2"](aux))).float()
        return main[:, 0], main[:, 1], aux[:, :6], aux[:, 6]

    def stage(self, k: int, feature: Tensor, rows: int, columns: int, aspect: float) -> Tensor:
        x = self.norm(feature)
        project = self.projects[k]
        x = F.linear(x, project.weight.flatten(1), project.bias)
        x = x.transpose(1, 2).reshape(x.shape[0], -1, rows, columns)
        x = x + uv_embedding(x.shape[1], rows, columns, aspect).to(x.device)
        x = self.resize_layers[k](x.contiguous(memory_format=torch.channels_last))
        return getattr(self.scratch, f"layer{k + 1}_rn")(x)

    def chain(self, levels: list[Tensor], fine: tuple[int, int], suffix: str) -> Tensor:
        l1, l2, l3, l4 = levels

        def fuse(k: int, x: Tensor, lateral: Tensor | None, size: tuple[int, int]) -> Tensor:
            return getattr(self.scratch, f"refinenet{k}{suffix}")(x, lateral, size)

        size = lambda t: tuple(t.shape[-2:])  # noqa: E731
        x = fuse(4, l4, None, size(l3))
        x = fuse(3, x, l3, size(l2))
        x = fuse(2, x, l2, size(l1))
        return fuse(1, x, l1, fine)


class Nano(nn.Module):
    """The whole network."""

    def __init__(self, config: NanoConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone = nn.ModuleDict({"pretrained": Backbone(config)})
        self.cam_enc = CameraEncoder(config)
        self.cam_dec = CameraDecoder(config)
        self.head = DualDpt(config)
        initialise(self)

    def forward(
        self,
        images: Tensor,
        pose9: Tensor | None = None,
        wants_rays: bool = True,
        select: bool = False,
        autocast: bool = False,
    ) -> Output:
        """Normalised images [B, S, 3, H, W] and given cameras [B, S, 9] or None."""
        scenes, views, _, height, width = images.shape
        with torch.autocast(images.device.type, torch.bfloat16, enabled=autocast):
            tokens = None if pose9 is None else self.cam_enc(pose9)
            features, reference = self.backbone["pretrained"](images, tokens, select)
        with torch.autocast(images.device.type, torch.bfloat16, enabled=autocast):
            patches = [f.flatten(0, 1) for f, _ in features]
            log_depth, log_conf, ray, log_ray_conf = self.head(patches, height, width, wants_rays)
        pose = self.cam_dec(features[-1][1].float())
        shape = (scenes, views)
        return Output(
            depth=log_depth.exp().unflatten(0, shape),
            log_depth=log_depth.unflatten(0, shape),
            depth_conf=1 + log_conf.exp().unflatten(0, shape),
            ray=None if ray is None else ray.unflatten(0, shape),
            ray_conf=None if log_ray_conf is None else 1 + log_ray_conf.exp().unflatten(0, shape),
            pose_enc=pose,
            reference=reference,
            logits=self.backbone["pretrained"].watched(),
            patches=features[2][0],
        )


@torch.no_grad()
def initialise(model: Nano) -> None:
    """Small random weights; the outputs begin at depth 1, identity rotation and a field of view of 1 rad."""
    for name, p in model.named_parameters():
        leaf = name.rsplit(".", 1)[-1]
        if leaf == "weight" and p.dim() >= 2:
            fan = p[0].numel() if "resize_layers.0" not in name and "resize_layers.1" not in name else p.shape[0]
            gain = 1.0
            if name.endswith(("attn.proj.weight", "mlp.fc2.weight")):
                gain = 0.3
            p.normal_(0, gain / math.sqrt(fan))
        elif leaf == "bias":
            p.zero_()
        elif leaf in ("cls_token", "camera_token", "pos_special"):
            p.normal_(0, 0.5)
        elif leaf == "pos_grid":
            p.normal_(0, 0.5)
    for block in model.backbone["pretrained"].blocks:
        similar_attention(block.attn)
    spread_poses(model.cam_enc)
    scratch = model.head.scratch
    for unit in [m for m in scratch.modules() if isinstance(m, ResidualUnit)]:
        unit.conv2.weight *= 0.2
    scratch.output_conv2[2].weight *= 0.1
    scratch.output_conv2_aux["3"]["5"].weight *= 0.1
    scratch.output_conv2_aux["3"]["5"].bias[2] = 0.8
    for last in (model.cam_dec.fc_t, model.cam_dec.fc_qvec, model.cam_dec.fc_fov[0]):
        last.weight *= 0.1
    # Camera tokens reach the decoder without a norm and grow to several units: its rectifiers must survive that.
    model.cam_dec.backbone[0].weight *= 0.3
    model.cam_dec.fc_qvec.bias[3] = 1
    model.cam_dec.fc_fov[0].bias.fill_(1)


def similar_attention(attention: Attention) -> None:
    """Queries begin nearly equal to keys, so that tokens attend to what resembles them (Trockman and Kolter 2023).

    Across views this is a first guess at correspondence, which takes long to emerge from independent weights.
    """
    dim = attention.proj.in_features
    weight = attention.qkv.weight
    weight[:dim] = 0.9 * weight[dim : 2 * dim] + 0.3 * weight[:dim]
    if attention.qk_norm:
        attention.q_norm.weight.fill_(0.8)
        attention.k_norm.weight.fill_(0.8)


@torch.no_grad()
def spread_poses(encoder: CameraEncoder) -> None:
    """Makes tokens of neighbouring cameras differ from the start: rotations of a few degrees are small numbers."""
    first, second = encoder.pose_branch.fc1, encoder.pose_branch.fc2
    sensitivity = torch.tensor([1.0, 1, 1, 5, 5, 5, 1, 2, 2])
    first.weight.copy_(torch.randn_like(first.weight) * sensitivity)
    first.bias.uniform_(-2, 2)
    second.weight.normal_(0, 2 / math.sqrt(second.in_features))


@torch.no_grad()
def whiten_patches(model: Nano, images: Tensor) -> None:
    """Begins the patch embedding as the whitened principal components of patches of `images` [V, 3, H, W].

    Neighbouring pixels are so alike that random filters all see the mean; whitened ones see edges as well.
    """
    embed = model.backbone["pretrained"].patch_embed
    views, _, height, width = images.shape
    rows, columns = height // PATCH, width // PATCH
    x = images.reshape(views, 3, rows, PATCH, columns, PATCH).permute(0, 2, 4, 1, 3, 5).flatten(3).flatten(0, 2)
    x = x.double() - x.double().mean(0)
    values, vectors = torch.linalg.eigh(x.T @ x / len(x))
    dim = model.config.dim
    values, vectors = values[-dim:].flip(0), vectors[:, -dim:].flip(1)
    # Fine detail is partly noise: it is raised less than to full variance.
    filters = vectors / (values + 0.02).sqrt()
    # A random rotation spreads the components over all channels.
    rotation = torch.linalg.qr(torch.randn(dim, dim, dtype=torch.float64))[0]
    embed.proj.weight.copy_((rotation @ filters.T).float().view_as(embed.proj.weight))
    embed.proj.bias.zero_()
