"""The layers of a plan as torch modules, and batch normalisation folded into convolutions."""

from itertools import pairwise

from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from mtlnet.plan import HEIGHT, WIDTH, Conv, LocalNorm, Plan, Pool, output_size, same_padding

NORM_EPS = 1e-5
NORM_MOMENTUM = 0.1


class SamePad(nn.Module):
    """Zeros around an image, as SAME padding of the next layer asks."""

    def __init__(self, height: int, width: int, layer: Conv | Pool) -> None:
        super().__init__()
        self.out_height, top, bottom = same_padding(height, layer.kernel, layer.stride)
        self.out_width, left, right = same_padding(width, layer.kernel, layer.stride)
        self.pads = (left, right, top, bottom)

    def forward(self, x: Tensor) -> Tensor:
        # A maximum of values after ReLU is not changed by zeros, so pools are padded with them too.
        return nn.functional.pad(x, self.pads) if any(self.pads) else x


def block(layer: nn.Module, norm: nn.Module | None, dropout: float = 0.0) -> nn.Sequential:
    """layer - [batch normalisation] - ReLU - [dropout]."""
    parts: list[tuple[str, nn.Module]] = [("layer", layer)]
    if norm is not None:
        parts.append(("norm", norm))
    parts.append(("relu", nn.ReLU()))
    if dropout:
        parts.append(("dropout", nn.Dropout(dropout)))
    sequence = nn.Sequential()
    for name, part in parts:
        sequence.add_module(name, part)
    return sequence


def build_features(plan: Plan, *, batch_norm: bool) -> tuple[nn.Module, int]:
    """The part before the fully connected layers, (B, 3, H, W) -> (B, ...), and its size."""
    if plan.backbone:
        return build_backbone(plan.name, batch_norm=batch_norm)
    features = nn.Sequential()
    channels, height, width = 3, HEIGHT, WIDTH
    for number, spec in enumerate(plan.features):
        if isinstance(spec, LocalNorm):
            norm = nn.LocalResponseNorm(spec.size, spec.alpha, spec.beta)
            features.add_module(f"norm{number}", norm)
            continue
        if spec.same if isinstance(spec, Pool) else spec.pad is None:
            features.add_module(f"pad{number}", SamePad(height, width, spec))
        height, width = output_size(height, spec), output_size(width, spec)
        if isinstance(spec, Pool):
            pool = nn.MaxPool2d(spec.kernel, spec.stride, ceil_mode=not spec.same)
            features.add_module(f"pool{number}", pool)
            continue
        features.add_module(f"conv{number}", _convolution(channels, spec, batch_norm))
        channels = spec.filters
    return features, channels * height * width


def _convolution(channels: int, spec: Conv, batch_norm: bool) -> nn.Sequential:
    conv = nn.Conv2d(
        channels,
        spec.filters,
        spec.kernel,
        spec.stride,
        padding=spec.pad or 0,
        groups=spec.groups,
        bias=not batch_norm,
    )
    return block(conv, nn.BatchNorm2d(spec.filters, eps=NORM_EPS) if batch_norm else None)


def build_backbone(name: str, *, batch_norm: bool) -> tuple[nn.Module, int]:
    """A torchvision model up to its pooled features, random weights, and their number.

    Without `batch_norm`: the form it takes once its normalisation is folded away.
    """
    from torchvision.models import get_model

    model: nn.Module = get_model(name, weights=None)
    last = "fc" if hasattr(model, "fc") else "classifier"
    classifier = next(m for m in getattr(model, last).modules() if isinstance(m, nn.Linear))
    setattr(model, last, nn.Identity())
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            # torchvision's 0.01 is for runs of 100,000 steps: after 500 the means would be stale.
            module.momentum = NORM_MOMENTUM
    if not batch_norm:
        fold_norms(model)
    return model, int(classifier.in_features)


def fold_norms(network: nn.Module) -> None:
    """Fold every batch normalisation into the convolution before it, in evaluation mode."""
    network.eval()
    for sequence in [m for m in network.modules() if isinstance(m, nn.Sequential)]:
        for (first, conv), (second, norm) in pairwise(list(sequence.named_children())):
            if isinstance(conv, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                setattr(sequence, first, fuse_conv_bn_eval(conv, norm))
                setattr(sequence, second, nn.Identity())
