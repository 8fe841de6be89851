"""How GroundingDINO and SAM 2 are called, with tiny, randomly initialized models: real code of `transformers`, no weights.

SAM 2's image and video processors need torchvision, which has no CPU build for every platform: two functions stand in for them.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from neuspring.config.perception import GroundedSam2
from neuspring.core.errors import InputError
from neuspring.perception import segment_sam2
from neuspring.perception.segment_sam2 import Detection, Models
from tests.support.filmed import FRAMES, film
from tests.support.marked import mark

transformers = pytest.importorskip("transformers", reason="needs the extra perception")
torch = pytest.importorskip("torch")

SIDE = 64
"""Side of the images for the tiny SAM 2, px."""
WORDS = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", "toy", "hand"]


class VideoProcessor:
    """Resize and scale, as SAM 2's video processor does."""

    def __call__(self, videos, device=None, return_tensors="pt", **_):
        frames = torch.from_numpy(np.stack(videos)).permute(0, 3, 1, 2).float() / 255.0
        scaled = torch.nn.functional.interpolate(frames, (SIDE, SIDE), mode="bilinear")
        return SimpleNamespace(pixel_values_videos=scaled[None], original_sizes=[list(videos[0].shape[:2])])


class ImageProcessor:
    """Masks back to the size of the images."""

    def post_process_masks(self, masks, original_sizes, mask_threshold=0.0, binarize=True, *_):
        sized = [
            torch.nn.functional.interpolate(mask.float(), tuple(size), mode="bilinear")
            for mask, size in zip(masks, original_sizes, strict=True)
        ]
        return [mask > mask_threshold for mask in sized] if binarize else sized


def video_models():
    config = transformers.Sam2VideoConfig(
        vision_config={
            "backbone_config": {
                "model_type": "sam2_hiera_det_model",
                "hidden_size": 8,
                "image_size": [SIDE, SIDE],
                "blocks_per_stage": [1, 2, 2, 1],
                "embed_dim_per_stage": [8, 16, 32, 64],
                "num_attention_heads_per_stage": [1, 1, 2, 2],
                "window_size_per_stage": [8, 4, 4, 2],
                "global_attention_blocks": [4],
            },
            "backbone_channel_list": [64, 32, 16, 8],
            "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
            "fpn_hidden_size": 128,
        },
        prompt_encoder_config={"hidden_size": 128, "image_size": SIDE, "patch_size": 16},
        mask_decoder_config={"hidden_size": 128, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 16},
        image_size=SIDE,
        memory_attention_hidden_size=128,
        memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=32,
        memory_attention_rope_feat_sizes=[4, 4],
        memory_encoder_hidden_size=128,
        memory_encoder_output_channels=64,
        mask_downsampler_embed_dim=128,
        memory_fuser_embed_dim=128,
        memory_fuser_intermediate_dim=32,
    )
    processor = transformers.Sam2VideoProcessor.__new__(transformers.Sam2VideoProcessor)
    processor.image_processor, processor.video_processor = ImageProcessor(), VideoProcessor()
    processor.target_size, processor.point_pad_value = SIDE, -10
    return transformers.Sam2VideoModel(config).eval(), processor


def detector_models(tmp_path):
    (tmp_path / "vocab.txt").write_text("\n".join(WORDS))
    config = transformers.GroundingDinoConfig(
        backbone_config={
            "model_type": "swin",
            "image_size": SIDE,
            "embed_dim": 8,
            "depths": [1, 1, 1, 1],
            "num_heads": [1, 1, 2, 2],
            "window_size": 4,
            "out_indices": [2, 3, 4],
        },
        text_config={
            "model_type": "bert",
            "vocab_size": len(WORDS),
            "hidden_size": 16,
            "num_hidden_layers": 1,
            "num_attention_heads": 2,
            "intermediate_size": 16,
        },
        d_model=32,
        encoder_layers=1,
        decoder_layers=2,
        encoder_attention_heads=2,
        decoder_attention_heads=2,
        encoder_ffn_dim=16,
        decoder_ffn_dim=16,
        num_queries=12,
        disable_custom_kernels=True,
    )
    tokenizer = transformers.BertTokenizerFast(vocab_file=str(tmp_path / "vocab.txt"), vocab=str(tmp_path / "vocab.txt"))
    images = transformers.GroundingDinoImageProcessor(size={"shortest_edge": 48, "longest_edge": 96})
    return transformers.GroundingDinoForObjectDetection(config).eval(), transformers.GroundingDinoProcessor(images, tokenizer)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return film(tmp_path_factory.mktemp("film"), cameras=1, missing={0: (2,)})


def test_sam2_carries_marks_both_ways_and_skips_missing_frames(capture):
    torch.manual_seed(0)
    model, processor = video_models()
    marks = [mark("object", "polygon", [(40, 30), (90, 30), (90, 70), (40, 70)], frame=1)]
    marks.append(mark("hand", "box", [(60, 5), (100, 40)], frame=3))
    heard = []
    propagate = segment_sam2.propagate

    def hear(images, prompts, *rest, **options):
        result = propagate(images, prompts, *rest, **options)
        heard.append((sorted(prompts), sorted(result)))
        return result

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segment_sam2, "propagate", hear)
        carried = segment_sam2.carry(capture, "0", marks, None, GroundedSam2(), "cpu", Models(None, None, model, processor))
    # Frame 2 is missing: frames 3 to 5 are the third to the fifth that there are.
    assert heard[0] == ([1], [0, 1, 2, 3, 4])
    assert [prompts for prompts, _ in heard[1:]] in ([[2]], [])
    assert carried.labels.shape == (FRAMES, 90, 160)
    assert not carried.labels[2].any()
    assert set(np.unique(carried.labels)) <= {0, 1, 2}
    assert (carried.doubt[[0, 1, 3, 4, 5]] >= 0).all()


def test_marks_without_an_object_start_nothing(capture):
    with pytest.raises(InputError, match=r"an object must be annotated.*received \['hand'\]"):
        segment_sam2.carry(
            capture, "0", [mark("hand", "click", [(5, 5)])], None, GroundedSam2(), "cpu", Models(None, None, None, None)
        )


def test_grounding_dino_finds_boxes_in_the_image(capture, tmp_path, monkeypatch):
    torch.manual_seed(0)
    model, processor = detector_models(tmp_path)
    monkeypatch.setattr(segment_sam2, "BOX_SCORE", 0.001)
    monkeypatch.setattr(segment_sam2, "WORD_SCORE", 0.001)
    detections = segment_sam2.detect(capture.color("0", 0), "toy", Models(model, processor, None, None), "cpu")
    assert detections
    assert [d.score for d in detections] == sorted((d.score for d in detections), reverse=True)
    assert all(len(d.box) == 4 and np.isfinite(d.box).all() for d in detections)
    assert {word for d in detections for word in d.words.replace(".", " ").split()} <= {"toy", "hand", "[CLS]", "[SEP]"}


def test_hands_lie_over_the_object_and_missing_frames_stay_empty(capture, monkeypatch):
    detections = [Detection((0.0, 0.0, 9.0, 9.0), "hand", 0.9), Detection((0.0, 0.0, 9.0, 9.0), "toy", 0.8)]
    both = np.full((2, 90, 160), -1.0)
    both[0, 10:20, 10:20] = both[1, 15:30, 15:30] = 1.0
    monkeypatch.setattr(segment_sam2, "detect", lambda *_: detections)
    monkeypatch.setattr(segment_sam2, "propagate", lambda images, *_: dict.fromkeys(range(len(images)), both))
    labels = segment_sam2.segment(capture, "0", GroundedSam2(), "cpu", Models(None, None, None, None))
    assert labels.shape == (FRAMES, 90, 160)
    assert (labels[0][10:20, 10:20] == 2).all()
    assert labels[0][25, 25] == 1
    assert not labels[2].any()


@pytest.mark.parametrize(("words", "what"), [("toy", "no hand"), ("hand", "no object")])
def test_what_the_prompt_does_not_find_is_said(capture, monkeypatch, words, what):
    monkeypatch.setattr(segment_sam2, "detect", lambda *_: [Detection((0.0, 0.0, 9.0, 9.0), words, 0.9)])
    with pytest.raises(InputError, match=rf"{what} among \['{words}'\].*other words for the object"):
        segment_sam2.segment(capture, "0", GroundedSam2(), "cpu", Models(None, None, None, None))


def test_missing_weights_name_the_models_and_the_way_out(capture, monkeypatch, tmp_path):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr(segment_sam2, "DETECTOR", str(tmp_path / "no_detector"))
    with pytest.raises(InputError, match=r"no_detector and facebook/sam2.* must be in the Hugging Face cache.*download: true once"):
        segment_sam2.load(GroundedSam2(), "cpu")
