"""The export scripts of docs/teachers.md run as they stand, on small stand-ins with the real
models' interface.
"""

import re
import sys
import types
import warnings

import numpy as np
import pytest
import torch
from shared import ROOT

from chebsplat.stages.tools.get_teacher import check

TEXT = (ROOT / "docs/teachers.md").read_text()
SCRIPTS = {
    name: "# " + body
    for name, body in re.findall(r"```python\n# (?=(\w+)\.py)(.*?)```", TEXT, re.DOTALL)
}
SETTINGS = {
    re.search(r'name = "(\w+)"', block)[1]: block
    for block in re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL)
}
NAMES = ["wall", "floor", "chair"]


def conv(n_in, n_out, stride=1):
    return torch.nn.Conv2d(n_in, n_out, stride, stride=stride)


class Fusion(torch.nn.Module):
    def forward(self, path, skip=None):
        path = path if skip is None else path + skip
        return torch.nn.functional.interpolate(
            path, scale_factor=2, mode="bilinear", align_corners=True
        )


class LSegNet(torch.nn.Module):
    """Layers at 1/4 to 1/32 of the image through hooks, fused to half of it, and a text encoder
    that halves floats.
    """

    def __init__(self, labels, backbone, features, crop_size, arch_option, block_depth, activation):
        super().__init__()
        clip = sys.modules["clip"]
        self.clip_pretrained, _ = clip.load("ViT-B/32", device="cuda", jit=False)
        self.pretrained = torch.nn.Module()
        self.pretrained.layers = torch.nn.ModuleList(
            [conv(3, 8, 4), conv(8, 8, 2), conv(8, 8, 2), conv(8, 8, 2)]
        )
        self.scratch = torch.nn.Module()
        for k in range(1, 5):
            setattr(self.scratch, f"layer{k}_rn", conv(8, 8))
            setattr(self.scratch, f"refinenet{k}", Fusion())
        self.scratch.head1 = conv(8, 512)


def forward_vit(pretrained, image):
    held = {}
    for k, layer in enumerate(pretrained.layers):
        image = held[k] = layer(image)
    return tuple(held.values())


class ClipText(torch.nn.Module):
    def encode_text(self, tokens):
        return tokens[:, :1].half() + torch.linspace(-1, 1, 512).half()


class DinoTxt(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.patches = conv(3, 96, 14)

    def get_visual_class_and_patch_tokens(self, image):
        tokens = self.patches(image).flatten(2).transpose(1, 2)
        return tokens.mean(1), tokens

    def encode_text(self, tokens):
        return torch.cat(
            [torch.full((len(tokens), 96), torch.nan), torch.randn(len(tokens), 96)], 1
        )


class Segmenter(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.config = types.SimpleNamespace(id2label=dict(enumerate(NAMES)), num_labels=3)
        self.head = conv(3, 3, 4)

    def forward(self, pixel_values):
        return types.SimpleNamespace(logits=self.head(pixel_values))


def stand_ins(monkeypatch, tmp_path):
    def module(name, **values):
        found = types.ModuleType(name)
        found.__dict__.update(values)
        monkeypatch.setitem(sys.modules, name, found)

    def load(name, device, jit):
        assert device == "cpu"  # the checkout asks for cuda
        return ClipText(), None

    module("clip", load=lambda name, device, jit: (ClipText(), None))
    net = LSegNet(NAMES, "", 0, 0, 0, 0, "")
    module(
        "clip", load=load, tokenize=lambda names: torch.arange(1, 1 + len(names))[:, None].float()
    )
    for name in ("modules", "modules.models", "dinov2", "dinov2.hub"):
        module(name)
    module("modules.models.lseg_net", LSegNet=LSegNet)
    module("modules.models.lseg_vit", forward_vit=forward_vit)
    tokenizer = types.SimpleNamespace(tokenize=lambda texts: torch.zeros(len(texts), 77))
    module(
        "dinov2.hub.dinotxt",
        dinov2_vitl14_reg4_dinotxt_tet1280d20h24l=DinoTxt,
        get_tokenizer=lambda: tokenizer,
    )
    loader = types.SimpleNamespace(from_pretrained=lambda name: Segmenter())
    module("transformers", AutoModelForSemanticSegmentation=loader)
    (tmp_path / "labels.txt").write_text("\n".join(NAMES) + "\n")
    held = {
        "state_dict": {f"net.{k}": v for k, v in net.state_dict().items()}
        | {"criterion.weight": torch.ones(3)}
    }
    torch.save(held, tmp_path / "demo_e200.ckpt")
    monkeypatch.chdir(tmp_path)
    space = {}
    exec(SCRIPTS["export_teacher"], space)
    module("export_teacher", export=space["export"])


EXPECTED = {
    "lseg": ("features, 512 channels, reduced", "seen at 520 x 390", "2 of 480 x 480"),
    "dinotxt": ("features, 96 channels, reduced", "seen at 690 x 518", "2 of 518 x 518"),
    "segformer": ("logits, 3 channels", "seen at 683 x 512", "2 of 512 x 512"),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_an_export_script_of_the_document_makes_a_teacher(name, tmp_path, monkeypatch):
    from PIL import Image

    stand_ins(monkeypatch, tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter warns about its own future
        exec(compile(SCRIPTS[name], f"{name}.py", "exec"), {"__name__": "__main__"})
    lines = SETTINGS[name].splitlines()
    drop = ("text", "tokenizer", "prompt") if name == "lseg" else ()
    (tmp_path / f"{name}.toml").write_text(
        "\n".join(line for line in lines if not line.startswith(drop or "-"))
    )
    pixels = np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "photo.png")
    found = dict(check(tmp_path / f"{name}.onnx", [tmp_path / "photo.png"]))
    for told, expected in zip(("output", "image", "windows"), EXPECTED[name], strict=True):
        assert expected in found[told]
    assert found["labels"].startswith("3, from ")


def test_the_document_s_scripts_need_nothing_of_chebsplat():
    assert len(SCRIPTS) == 4
    assert not any("chebsplat" in script for script in SCRIPTS.values())
