"""What a dataset of latents tells of itself."""

from pathlib import Path

import pytest

from lerobot_wm.data.latents import RECORD_PATH, LatentRecord


@pytest.mark.parametrize("content", ["{", "[]", "{}", '{"unknown": 1}'])
def test_a_damaged_record_is_refused(content: str, tmp_path: Path) -> None:
    path = tmp_path / RECORD_PATH
    path.parent.mkdir()
    LatentRecord("abc", "user/images", "def", ["Lift"], False).write(tmp_path)
    assert LatentRecord.read(tmp_path).tasks == ["Lift"]
    path.write_text(content)
    with pytest.raises(ValueError, match=r"latents\.json"):
        LatentRecord.read(tmp_path)
