"""`neuspring doctor` reports what is installed, what is missing, and what cannot work as configured."""

from neuspring import config
from neuspring.cli.main import main
from neuspring.extensions.doctor import machine as doctor


def findings(tmp_path, **values):
    settings = config.parse(config.Config, {"results": str(tmp_path), "device": "cpu"} | values, "test")
    return {finding.subject: finding for finding in doctor.examine(settings)}


def test_what_is_not_configured_is_absent_and_no_fault(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub"))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    found = findings(tmp_path)
    assert not [finding for finding in found.values() if finding.state == "broken"]
    for subject in ("LPIPS (AlexNet)", "VGG16 (Spring-Gaus' features)", "CoTracker3"):
        assert found[subject].state == "absent" and "curl" in found[subject].remedy
    assert "This machine can run the configuration." in doctor.text(list(found.values()))


def test_what_is_configured_and_cannot_work_is_broken_with_the_next_move(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub"))
    found = findings(tmp_path, perception={"track": {"backend": "cotracker3"}})
    broken = {name: finding for name, finding in found.items() if finding.state == "broken"}
    assert set(broken) == {"CoTracker3"}
    assert all(finding.remedy for finding in broken.values())
    settings = f"{{results: {tmp_path}, device: cpu, perception: {{track: {{backend: cotracker3}}}}}}"
    (tmp_path / "chosen.yaml").write_text(settings)
    assert main(["doctor", "--settings", str(tmp_path / "chosen.yaml")]) == 1
    assert "The configuration needs: CoTracker3." in capsys.readouterr().out
