"""Tests of the training code; a few seconds on one core: `python -m pytest training/tests`."""

from __future__ import annotations

import io
import math
import random
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from nano.anatomy import beyond_plane, cells, parts, read_linearly  # noqa: E402
from nano.augment import compressed, photographed, repainted, shaded, varied  # noqa: E402
from nano.begin import tapped, trainable, widened  # noqa: E402
from nano.config import NanoConfig  # noqa: E402
from nano.data import Clip, Pool, Renderer, read_clip, scenes, write_clip  # noqa: E402
from nano.evaluate import softened  # noqa: E402
from nano.export import exported, imported, mean  # noqa: E402
from nano.filters import smooth  # noqa: E402
from nano.geometry import homogeneous, inverse, matches, matrix_from_quaternion, quaternion_from_matrix  # noqa: E402
from nano.halves import read_weights, write_weights  # noqa: E402
from nano.losses import WATCHED, depth_terms, differences, match_terms, relative, total  # noqa: E402
from nano.metrics import depth_errors, pair_errors, scale_from_poses  # noqa: E402
from nano.model import Nano, Output, position_operator, reference_first  # noqa: E402
from nano.optim import Muon, optimisers, orthogonalised  # noqa: E402
from nano.train import Recipe, Stage, Team, Trainer  # noqa: E402

SMALL = NanoConfig(dim=32, heads=2, features=8, out_channels=(8, 8, 8, 8), cam_enc_heads=2, cam_enc_depth=1)


def rotations(count: int) -> torch.Tensor:
    """Random rotations, half turns among them."""
    torch.manual_seed(0)
    q = torch.randn(count, 4, dtype=torch.float64)
    q[0] = torch.tensor([1.0, 0, 0, 0])
    return matrix_from_quaternion(q)


def clip(views: int = 4, height: int = 28, width: int = 42) -> Clip:
    """A clip of a plane that faces the first camera, 2 m ahead, seen by cameras that step sideways."""
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (views, height, width, 3), dtype=np.uint8)
    pose = np.tile(np.eye(4, dtype=np.float32)[:3], (views, 1, 1))
    pose[:, 0, 3] = 0.3 * np.arange(views)
    pose[:, 1, 3] = 0.05 * np.arange(views) ** 2
    return Clip(7, 3, image, np.full((views, height, width), 2, np.float32), pose, (40.0, 41.0))


def perfect(batch) -> Output:  # noqa: ANN001
    """The answer without error."""
    views, (height, width) = batch.depth.shape[1], batch.depth.shape[2:]
    quaternion = quaternion_from_matrix(batch.first_from_camera[..., :3, :3])
    size = torch.tensor([height, width], dtype=torch.float32)
    fov = 2 * torch.atan(0.5 * size / batch.focal.flip(-1))
    pose = torch.cat([batch.first_from_camera[..., :3, 3], quaternion, fov], -1)
    ones = torch.ones_like(batch.depth)
    return Output(batch.depth, 1 + ones, batch.depth.log(), None, None, pose, torch.zeros(1, views))


def test_a_clip_survives_the_stream():
    stream = io.BytesIO()
    for _ in range(2):
        write_clip(clip(), stream)
    stream.seek(0)
    first, second, end = read_clip(stream), read_clip(stream), read_clip(stream)
    assert end is None and first is not None and second is not None
    assert (first.seed, first.number, first.focal) == (7, 3, (40.0, 41.0))
    assert np.array_equal(second.image, clip().image) and np.array_equal(second.depth, clip().depth)
    assert np.array_equal(first.world_from_camera, clip().world_from_camera)


def test_the_aligned_term_is_what_depth_is_judged_by():
    batch = scenes([(clip(), [0, 1, 2, 3], False)])
    torch.manual_seed(3)
    wrong = (0.2 * torch.randn_like(batch.depth)).requires_grad_()
    answer = replace(perfect(batch), log_depth=batch.depth.log() + 0.4 + wrong)
    term = depth_terms(answer, batch)["aligned"]
    judged = depth_errors(answer.log_depth.detach().exp()[0], batch.depth[0])[0]
    assert term.item() == pytest.approx(judged, rel=1e-3)
    # However wrong the common scale is, it is neither judged nor pulled at here.
    (gradient,) = torch.autograd.grad(term, wrong)
    assert abs(gradient.sum()) < 1e-5 * gradient.abs().sum()


def test_relative_errors_stay_finite_however_far_too_deep():
    ratio = torch.tensor([-50.0, -0.1, 0.0, 0.1, 1.0, 1.001, 50.0])
    found = relative(ratio)
    assert torch.allclose(found[:5], (ratio[:5].exp() - 1).abs())
    assert found[-1] < 150
    assert (found[5] - found[4]).item() == pytest.approx(0.001 * math.e, rel=0.01)


def test_differences_see_detail_where_whole_surfaces_are_off_and_where_depth_is_known():
    truth = torch.zeros(1, 1, 20, 40)
    truth[..., 20:] = 1.0
    ramp = ((torch.arange(40.0) - 14) / 12).clamp(0, 1).expand_as(truth)
    known = torch.ones_like(truth, dtype=torch.bool)
    cost = {d: [differences(p - truth, known, d).item() for p in (ramp, torch.zeros_like(truth))] for d in (1, 12)}
    assert cost[1][0] > cost[1][1], "over one pixel no edge at all is cheaper than a blurred one"
    assert cost[12][0] < 0.7 * cost[12][1], "and over twelve it is dearer"
    shifted = differences(ramp - truth + 0.3, known, 12).item()
    assert shifted == pytest.approx(cost[12][0], rel=1e-4), "a whole surface's error is not counted"
    wrong = ramp - truth
    wrong[..., 5] = 100.0
    known[..., 5] = False
    assert differences(wrong, known, 12) < 1, "what is not known does not count"


def test_a_cut_or_foreign_stream_is_refused():
    stream = io.BytesIO()
    write_clip(clip(), stream)
    with pytest.raises(ValueError, match="ends within"):
        read_clip(io.BytesIO(stream.getvalue()[:-5]))
    with pytest.raises(ValueError, match="expected"):
        read_clip(io.BytesIO(b"x" * 100))


def test_quaternions_go_there_and_back():
    matrices = rotations(50)
    back = matrix_from_quaternion(quaternion_from_matrix(matrices))
    assert torch.allclose(back, matrices, atol=1e-9)
    assert (quaternion_from_matrix(matrices)[:, 3] >= 0).all()


def test_a_mirrored_scene_projects_mirrored():
    batch = scenes([(clip(), [0, 1, 2, 3], True)])
    # A step to the right becomes a step to the left.
    assert (batch.first_from_camera[0, 1:, 0, 3] < 0).all() and (batch.first_from_camera[0, 1:, 1, 3] > 0).all()
    assert torch.equal(batch.images[0, 0], scenes([(clip(), [0], False)]).images[0, 0].flip(-1))


def test_the_gauge_makes_the_mean_distance_one():
    batch = scenes([(clip(), [0], False)])
    assert 0.9 < batch.depth.mean().item() < 1.0
    assert 2.0 < batch.scale.item() < 2.2


def test_the_perfect_answer_has_the_least_loss():
    batch = scenes([(clip(), [0, 1, 2, 3], False)])
    best, terms = total(perfect(batch), batch)
    assert terms["t"] < 1e-3 and terms["q"] < 1e-3 and terms["fov"] < 1e-3
    for spoil in ("depth", "pose"):
        answer = perfect(batch)
        if spoil == "depth":
            answer.log_depth = answer.log_depth + 0.1 * torch.randn_like(answer.log_depth)
        else:
            answer.pose_enc = answer.pose_enc + 0.1
        assert total(answer, batch)[0] > best + 0.01
    # With a factor, the same terms count for more.
    twice, once = (total(perfect(batch), batch, depth=factor)[0] for factor in (2.0, 1.0))
    none = total(perfect(batch), batch, depth=0.0)[0]
    torch.testing.assert_close(twice - once, once - none)
    assert abs(once - none) > 0.01


def test_exported_networks_answer_as_before_and_have_official_keys():
    torch.manual_seed(2)
    model = Nano(SMALL).eval()
    tensors = exported(model)
    for key in (
        "model.backbone.pretrained.pos_embed",
        "model.backbone.pretrained.camera_token",
        "model.backbone.pretrained.blocks.11.attn.q_norm.weight",
        "model.cam_enc.trunk.0.ls1.gamma",
        "model.cam_dec.fc_fov.0.weight",
        "model.head.scratch.refinenet4_aux.resConfUnit2.conv1.weight",
        "model.head.scratch.output_conv1_aux.3.4.bias",
        "model.head.scratch.output_conv2_aux.0.2.weight",
        "model.head.scratch.output_conv2_aux.3.5.weight",
    ):
        assert key in tensors, key
    assert not any("pos_grid" in key or "pos_special" in key for key in tensors)
    again = imported(tensors, SMALL)
    images = scenes([(clip(), [0, 1, 2, 3], False)]).images
    with torch.no_grad():
        a, b = model(images, select=True), again(images, select=True)
    assert torch.allclose(a.depth, b.depth, rtol=1e-4) and torch.allclose(a.pose_enc, b.pose_enc, atol=1e-5)


def test_views_do_not_mix_between_scenes_and_their_order_does_not_matter():
    torch.manual_seed(3)
    model = Nano(SMALL).eval()
    images = scenes([(clip(), [0, 1, 2], False), (clip(), [3, 2, 1], True)]).images
    with torch.no_grad():
        both, alone = model(images), model(images[1:])
        turned = model(images[:, [0, 2, 1]])
    assert torch.allclose(both.depth[1:], alone.depth, rtol=1e-4)
    assert torch.allclose(both.depth[:, [0, 2, 1]], turned.depth, rtol=1e-3)


def test_positions_of_any_size_lie_within_the_trained_ones():
    for rows, columns in ((5, 8), (10, 16), (13, 20), (37, 37)):
        weights = position_operator(7, rows, columns)
        assert weights.shape == (49, rows * columns)
        assert torch.allclose(weights.sum(0), torch.ones(rows * columns), atol=1e-5)


def test_the_reference_comes_first_and_the_others_keep_their_order():
    torch.manual_seed(4)
    order = reference_first(torch.randn(6, 5, 16))
    for row in order.tolist():
        assert sorted(row) == list(range(5)) and row[1:] == sorted(row[1:])


def test_orthogonalised_steps_have_singular_values_near_one():
    torch.manual_seed(5)
    for shape in ((24, 96), (96, 24)):
        values = torch.linalg.svdvals(orthogonalised(torch.randn(shape)))
        assert values.min() > 0.5 and values.max() < 1.4


def test_convolutions_of_the_head_get_orthogonal_steps_and_its_answers_do_not():
    model = Nano(SMALL)
    hidden = {id(p) for group in optimisers(model, 0.01, 0.01)[0].param_groups for p in group["params"]}
    scratch = model.head.scratch
    assert id(scratch.layer1_rn.weight) in hidden and id(model.head.projects[0].weight) in hidden
    assert id(scratch.output_conv2[2].weight) not in hidden
    assert id(scratch.output_conv2_aux["3"]["5"].weight) not in hidden
    convolution = torch.nn.Parameter(torch.zeros(8, 4, 3, 3))
    convolution.grad = torch.randn_like(convolution)
    Muon([convolution], 1.0, decay=0.0).step()
    values = torch.linalg.svdvals(convolution.detach().flatten(1))
    assert values.min() > 0.5 and values.max() < 1.4


def test_errors_of_a_scaled_truth_are_zero():
    batch = scenes([(clip(), [0, 1, 2, 3], False)])
    assert depth_errors(3 * batch.depth[0], batch.depth[0])[0] < 1e-6
    poses = batch.first_from_camera[0]
    rotation, direction = pair_errors(poses, poses, 1.0)
    assert rotation.max() < 0.1 and direction.max() < 0.1
    larger = poses.clone()
    larger[:, :3, 3] *= 2
    assert abs(scale_from_poses(larger, poses).item() - 0.5) < 1e-5
    assert torch.allclose(inverse(inverse(poses)), poses, atol=1e-6)
    assert homogeneous(poses[:, :3]).shape == poses.shape


def test_patches_are_found_again_where_the_camera_moved():
    batch = scenes([(clip(2), [0, 1], False)])
    index, weight, seen = matches(batch.depth, batch.first_from_camera, batch.focal, 2, 3)
    column = (weight * (index % 3)).sum(-1)
    row = (weight * (index // 3)).sum(-1)
    # 40 px of focal length, 0.3 m aside and 0.05 m down, 2 m away, patches of 14 px.
    shift = torch.tensor([40 * 0.3, 41 * 0.05]) / 2 / 14
    own = torch.arange(6)
    assert seen[0, 0, :, 1].all(), "all centres stay in the picture"
    assert not seen[0, 0, :, 0].any() and not seen[0, 1, :, 1].any(), "nobody is matched with itself"
    assert torch.allclose(weight.sum(-1), torch.ones(()))
    for p in range(6):
        assert abs(column[0, 0, p, 1] - (own[p] % 3 - shift[0]).clamp(min=0)) < 1e-5
        assert abs(row[0, 0, p, 1] - (own[p] // 3 - shift[1]).clamp(min=0)) < 1e-5


def test_what_something_hides_is_not_matched():
    batch = scenes([(clip(3), [0, 2], False)])
    far = matches(batch.depth, batch.first_from_camera, batch.focal, 2, 3)[2][0, 0, :, 1]
    assert far.tolist() == [False, True, True] * 2, "what leaves the picture on the left is not seen"
    batch.depth[:, 1] *= 0.5
    assert not matches(batch.depth, batch.first_from_camera, batch.focal, 2, 3)[2][0, 0, :, 1].any()


def test_attention_to_the_right_patches_costs_nothing():
    batch = scenes([(clip(3), [0, 1, 2], False)])
    index, weight, seen = matches(batch.depth, batch.first_from_camera, batch.focal, 2, 3)
    tokens, scale = 7, 30.0
    logits = torch.full((1, 2, 3, tokens, 3, tokens), -scale)
    patches = torch.full((1, 3, 6, 3, 6), -scale).scatter(-1, index, weight.clamp(min=1e-12).log())
    logits[:, 0, :, 1:, :, 1:] = patches
    logits[:, 1, :, 1:, 0, 1:] = patches[:, :, :, 0]
    logits = logits.reshape(1, 2, 3 * tokens, 3 * tokens)
    right = perfect(batch)
    right.logits = {block: logits for block in WATCHED}
    wrong = perfect(batch)
    wrong.logits = {block: torch.zeros_like(logits) for block in WATCHED}
    column = (weight[..., 0, :] * (index[..., 0, :] % 3)).sum(-1) - torch.arange(6) % 3
    row = (weight[..., 0, :] * (index[..., 0, :] // 3)).sum(-1) - torch.arange(6) // 3
    right.patches = torch.stack([column, row], -1) / 3
    wrong.patches = torch.zeros_like(right.patches)
    good, bad = match_terms(right, batch, torch.nn.Identity()), match_terms(wrong, batch, torch.nn.Identity())
    assert all(abs(good[name]) < 1e-3 for name in good), good
    assert bad["pair"] > 0.5 and bad["first"] > bad["pair"] and bad["moved"] > 0.05, bad


def test_processes_average_their_gradients_and_share_the_directions():
    torch.manual_seed(0)
    shapes = [(24, 8), (8, 8), (32, 8), (8, 32)] * 3
    starts = [torch.randn(shape) for shape in shapes]
    found = [[torch.randn(shape) for shape in shapes] for _ in range(2)]
    alone = [torch.nn.Parameter(p.clone()) for p in starts]
    for p, a, b in zip(alone, *found, strict=True):
        p.grad = 0.5 * (a + b)
    Muon(alone, 0.01).step()
    team = Team(2, sum(p.numel() for p in alone) + 3)
    together = [[torch.nn.Parameter(p.clone()) for p in starts] for _ in range(2)]
    unused = [torch.nn.Parameter(torch.zeros(3)) for _ in range(2)]
    stops = [False, False]

    def work(rank: int) -> None:
        for p, g in zip(together[rank], found[rank], strict=True):
            p.grad = g.clone()
        optimiser = Muon(together[rank], 0.01)
        optimiser.divide(rank, 2, team.directions, team.barrier.wait)
        stops[rank] = team.average(rank, [*together[rank], unused[rank]], rank == 1)
        optimiser.step()

    threads = [threading.Thread(target=work, args=(rank,)) for rank in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert stops == [True, True], "who wants to stop stops all"
    assert unused[0].grad is None and unused[1].grad is None
    for one, a, b in zip(alone, *together, strict=True):
        assert torch.allclose(one, a, atol=1e-6) and torch.equal(a, b)


def test_training_goes_on_from_an_exported_network():
    torch.manual_seed(4)
    config = NanoConfig(dim=48, depth=4, heads=3, out_layers=(0, 1, 2, 3), cam_enc_depth=1)
    before = Nano(config).eval()
    after = trainable(imported({name: t.half() for name, t in exported(before).items()}, config)).eval()
    assert after.backbone["pretrained"].pos_full is None
    grids = [m.backbone["pretrained"].pos_grid for m in (before, after)]
    assert torch.allclose(*grids, atol=2e-3)
    images = torch.randn(1, 2, 3, 28, 42)
    with torch.no_grad():
        assert torch.allclose(before(images).log_depth, after(images).log_depth, atol=2e-2)


def test_a_head_with_more_channels_answers_as_before_and_learns_with_them():
    torch.manual_seed(6)
    narrow = Nano(SMALL).eval()
    wide = widened(narrow, (32, 16, 8, 16)).eval()
    images = torch.randn(1, 2, 3, 28, 42)
    with torch.no_grad():
        assert torch.allclose(narrow(images).log_depth, wide(images).log_depth, atol=1e-5)
        assert torch.allclose(narrow(images).ray, wide(images).ray, atol=1e-5)
    wide(images).log_depth.square().sum().backward()
    heard = wide.head.scratch.layer1_rn.weight.grad[:, 1::2]
    assert heard.abs().amax((0, 2, 3)).min() > 0, "the new channels carry something"
    with pytest.raises(ValueError, match="several times"):
        widened(narrow, (12, 8, 8, 8))


def test_a_head_that_reads_other_blocks_hears_about_the_same():
    torch.manual_seed(8)
    before = Nano(SMALL).eval()
    images = torch.randn(1, 4, 3, 56, 84)
    layers = (3, 7, 9, 11)
    fitted = tapped(before, layers, images).eval()
    assert fitted.config.out_layers == layers
    careless = Nano(replace(SMALL, out_layers=layers)).eval()
    careless.load_state_dict(before.state_dict())
    with torch.no_grad():
        truth, *others = (m(images).log_depth for m in (before, fitted, careless))
    near, far = ((other - truth).abs().mean() for other in others)
    assert 0 < near < 0.7 * far
    with torch.no_grad():
        assert torch.allclose(tapped(before, SMALL.out_layers, images)(images).log_depth, truth, atol=1e-6)


def test_processes_draw_clips_of_the_size_they_agreed_on():
    sizes = Stage(1, "168x112:3,98x84", 32).weighted_sizes()
    assert sizes == {(112, 168): 3, (84, 98): 1}

    def stored(width: int) -> Clip:
        whole = clip()
        return replace(whole, image=whole.image[:, :, :width], depth=whole.depth[:, :, :width])

    wide = clip().size[1]
    endless = iter([stored(wide), stored(wide - 2)] * 20)
    pool = Pool(endless, 12, 2, random.Random(1))
    for width in (wide, wide - 2, wide, wide):
        assert {c.size[1] for c in pool.draw(2, (clip().size[0], width))} == {width}
    # What is not there cannot be had: any other size will do.
    assert len(pool.draw(2, (1, 1))) == 2


def test_a_clip_stays_until_all_of_it_was_used_often_enough():
    clips = [replace(clip(), number=k) for k in range(20)]
    pool = Pool(iter(clips), 1, 2, random.Random(1))
    drawn = [pool.draw(1, share=0.5)[0].number for _ in range(16)]
    assert all(drawn.count(k) == 4 for k in drawn), "half of it, four times"


def test_a_step_takes_its_scenes_from_many_clips(tmp_path):
    trainer = Trainer.__new__(Trainer)
    trainer.device, trainer.rng, trainer.common_rng = "cpu", random.Random(1), random.Random(1)
    trainer.recipe = Recipe(0, 0, 0, 0, 0.5, 0, 1, 2, [])
    stage = Stage(1, "42x28", 32, views_per_clip=16, scene_views="1:1,3:1,8:1,16:1")
    endless = (replace(clip(16), number=k) for k in range(10**6))
    drawn = []

    class Watched(Pool):
        def draw(self, *arguments):  # noqa: ANN002, ANN202
            drawn.append(super().draw(*arguments))
            return drawn[-1]

    pool = Watched(endless, 40, 2, random.Random(2))
    seen = set()
    for _ in range(40):
        batch, _ = trainer.batch(pool, stage)
        count, views = batch.depth.shape[:2]
        seen.add(views)
        assert count == {1: 32, 3: 10, 8: 4, 16: 2}[views]
        assert len({c.number for c in drawn[-1]}) == min(count, 24)
    assert seen == {1, 3, 8, 16}


def test_the_mean_of_networks_lies_between_them():
    config = NanoConfig(dim=48, depth=5, heads=3, out_layers=(1, 2, 3, 4), cam_enc_depth=1)
    torch.manual_seed(6)
    one, other = Nano(config), Nano(config)
    grown = Nano(replace(config, out_layers=(0, 2, 3, 4), out_channels=(24, 96, 96, 96)))
    a, b, c = (exported(m) for m in (one, other, grown))
    for name, found in exported(mean([(one, 0.25), (other, 0.75)])).items():
        assert torch.allclose(found, 0.25 * a[name] + 0.75 * b[name], atol=1e-6), name
    mixed = mean([(grown, 0.5), (one, 0.5)])
    assert mixed.config == grown.config
    for name, found in exported(mixed).items():
        own = a[name].shape != c[name].shape or "head.projects.0." in name
        assert torch.allclose(found, c[name] if own else (a[name] + c[name]) / 2, atol=1e-6), name


def test_errors_of_layout_and_of_detail_are_told_apart():
    torch.manual_seed(9)
    truth = torch.ones(2, 70, 112)
    truth[..., 56:] = 3.0
    blurred, tilted = smooth(truth.log(), 7).exp(), truth * torch.linspace(1, 1.5, 112)
    assert max(parts(2 * truth, truth).values()) < 1e-5
    detail, layout = parts(blurred, truth), parts(tilted, truth)
    assert detail["near a step"] > 10 * detail["elsewhere"]
    assert detail["true below 14 px"] < 0.5 * detail["all"] < detail["true beyond 14 px"]
    assert layout["true beyond 14 px"] < 0.5 * layout["all"] < layout["true below 14 px"]
    plane = torch.linspace(0, 1, 112) + torch.linspace(0, 2, 70)[:, None]
    assert beyond_plane(cells(plane[None])).abs().max() < 1e-5 < cells(plane[None]).abs().max()
    tokens = torch.randn(400, 8)
    assert read_linearly(tokens, tokens @ torch.randn(8, 3) + 2) > 0.999
    assert read_linearly(tokens, torch.randn(400, 3)) < 0.1


def test_a_share_of_the_scenes_look_different_and_their_views_alike() -> None:
    images = ((torch.rand(1, 1, 3, 14, 28) - 0.45) / 0.225).expand(200, 2, 3, 14, 28)
    assert varied(images, 0.0, random.Random(1)) is images
    changed = varied(images, 0.5, random.Random(1))
    assert torch.equal(changed, varied(images, 0.5, random.Random(1)))
    untouched = (changed == images).flatten(1).all(1)
    assert 60 < untouched.sum() < 140
    assert changed.isfinite().all()
    # Views of a scene differ by their exposure alone.
    views = torch.linspace(0.2, 0.6, 14 * 28).view(1, 1, 14, 28).expand(2, 3, 14, 28)
    for seed in range(20):
        a, b = repainted(views, random.Random(seed))
        inside = (a > 0.01) & (a < 0.99) & (b > 0.01) & (b < 0.99)
        ratio = (a / b)[inside]
        assert 0 <= min(a.min(), b.min()) and max(a.max(), b.max()) <= 1
        assert ratio.numel() == 0 or ratio.max() - ratio.min() < 1e-3


def test_a_small_camera_keeps_the_picture_and_treats_its_views_alike() -> None:
    y, x = torch.meshgrid(torch.linspace(0, 6, 30), torch.linspace(0, 9, 44), indexing="ij")
    one = (0.5 + 0.2 * torch.sin(x + torch.tensor([0.0, 1, 2])[:, None, None]) * torch.cos(y)).expand(2, 3, 30, 44)
    assert torch.allclose(compressed(one, 1e-6), one, atol=1e-4), "without rounding it is its own inverse"
    coarse = (compressed(one, 0.01) - one).abs()
    assert 0.001 < coarse.mean() < 0.02
    dark = shaded(torch.ones(1, 3, 30, 44), random.Random(1))
    assert dark[..., 15, 22].min() > 0.99 and 0.3 < dark[..., 0, 0].min() < dark[..., 0, 0].max() < 0.96
    changed = [photographed(one, random.Random(seed)) for seed in range(40)]
    assert all(0 <= c.min() and c.max() <= 1 for c in changed)
    # Noise alone tells two views of the same picture apart.
    assert all((c[0] - c[1]).abs().mean() < 0.03 for c in changed)
    assert all((c - one).mean((0, 1))[10:20, 15:30].abs().mean() < 0.06 for c in changed)
    assert sum(torch.equal(c, one) for c in changed) < 8, "seldom is nothing done"


def test_a_pool_has_the_clips_of_all_renderers(tmp_path: Path) -> None:
    program = tmp_path / "stream"
    body = tmp_path / "clip.bin"
    with body.open("wb") as out:
        write_clip(clip(), out)
    program.write_text(f"#!/bin/sh\ncat {body} {body}\n")
    program.chmod(0o755)
    assert len(list(Renderer(program, [[], [], []]))) == 6


def test_softening_blurs_pictures_alone() -> None:
    image = np.zeros((2, 14, 28, 3), np.uint8)
    image[:, 7, 14] = (200, 100, 50)
    clip = Clip(0, 0, image, np.ones((2, 14, 28), np.float16), np.zeros((2, 3, 4), np.float32), (20.0, 20.0))
    assert softened(clip, 0.0) is clip
    soft = softened(clip, 0.8)
    assert soft.depth is clip.depth and soft.image.dtype == np.uint8 and soft.image.shape == image.shape
    assert 0 < soft.image[0, 7, 15, 0] < soft.image[0, 7, 14, 0] < 200
    # What a point loses its neighbours get.
    assert abs(int(soft.image[0, :, :, 0].sum()) - 200) < 10


def test_weights_are_the_same_whole_and_in_halves(tmp_path: Path) -> None:
    data = bytes(range(251)) * 3
    whole, crate = tmp_path / "whole", tmp_path / "crate"
    whole.mkdir()
    (crate / "second-half").mkdir(parents=True)
    for folder in (whole, crate):
        write_weights(folder, data)
        assert read_weights(folder) == data
    assert [p.name for p in whole.iterdir()] == ["model.safetensors"]
    assert not (crate / "model.safetensors").exists()
