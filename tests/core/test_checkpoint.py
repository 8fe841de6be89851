"""Checkpoints and resumable training: a damaged or foreign checkpoint is kept, with a message."""

import numpy as np
import pytest
import torch

from neuspring.core.checkpoint import Checkpoint, TrainingLoop, adam_arrays, restore_adam


def test_arrays_come_back_in_their_groups_and_values_as_they_were(tmp_path):
    arrays = {"values": {"0.weight": np.arange(3.0), "a": np.zeros((2, 1), np.float32)}, "moments": {}}
    Checkpoint(arrays, {"best": float("inf"), "rows": [{"b": 1, "a": None}]}).save(tmp_path / "c.npz", "key")
    loaded = Checkpoint.load(tmp_path / "c.npz", "key", "the fit")
    assert loaded.values == {"best": float("inf"), "rows": [{"b": 1, "a": None}]}
    assert list(loaded.values["rows"][0]) == ["b", "a"], "columns of a history keep their order"
    assert set(loaded.arrays["values"]) == {"0.weight", "a"} and not loaded.arrays["moments"]
    np.testing.assert_array_equal(loaded.arrays["values"]["0.weight"], np.arange(3.0))


def test_a_foreign_or_damaged_checkpoint_is_left_alone(tmp_path, capsys):
    path = tmp_path / "c.npz"
    assert Checkpoint.load(None, "key", "the fit") is None and Checkpoint.load(path, "key", "the fit") is None
    Checkpoint({"values": {"a": np.zeros(2)}}, {}).save(path, "another key")
    whole = path.read_bytes()
    assert Checkpoint.load(path, "key", "the fit") is None
    assert "made with other inputs or settings; the fit starts over" in capsys.readouterr().out
    for content in (b"", b"hello", whole[: len(whole) // 2], whole.replace(b"another", b"\xff" * 7)):
        path.write_bytes(content)
        assert Checkpoint.load(path, "another key", "the fit") is None
        assert "unreadable" in capsys.readouterr().out
        assert path.read_bytes() == content


def test_a_killed_loop_continues_after_its_last_checkpoint(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("neuspring.core.checkpoint.CHECKPOINT_EVERY", 2)

    def loop():
        return TrainingLoop("the training", "train", 5, tmp_path / "c.npz", "key")

    first = loop()
    for number in first:
        first.record({"step": number}, "")
        first.save(lambda: Checkpoint({}, {"state": len(first.history)}))
        if number == 2:
            break
    second = loop()
    assert "resuming the training after epoch 1" in capsys.readouterr().out
    assert second.restored.values == {"state": 2} and second.attempts == 2
    assert second.earlier_seconds > 0
    for number in second:
        second.record({"step": number}, "")
    assert second.history == [{"step": number} for number in range(5)]


@pytest.mark.parametrize("kind", [torch.optim.Adam, torch.optim.AdamW])
def test_adam_goes_on_bit_for_bit(kind):
    def step(optimizer, parameters):
        optimizer.zero_grad()
        sum((parameter**3).sum() for parameter in parameters).backward()
        optimizer.step()

    parameters = [torch.linspace(0.1, 1, n).requires_grad_() for n in (5, 17)]
    optimizer = kind(parameters)
    assert adam_arrays(optimizer) == {}
    step(optimizer, parameters)
    copies = [parameter.detach().clone().requires_grad_() for parameter in parameters]
    restored = kind(copies, lr=1e-3)
    restore_adam(restored, adam_arrays(optimizer))
    for each in ((optimizer, parameters), (restored, copies)):
        step(*each)
    for parameter, copy in zip(parameters, copies, strict=True):
        assert torch.equal(parameter, copy)
