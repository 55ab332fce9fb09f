import pytest

from physx_core.errors import SessionError
from physx_core.session import Session


def test_new_sessions_get_the_next_number_whatever_lies_beside(tmp_path):
    (tmp_path / "run_old").mkdir()
    (tmp_path / "run_7").mkdir()
    names = [Session.create(tmp_path, "run").name for _ in range(3)]
    assert names == ["run", "run_8", "run_9"]


def test_an_existing_session_is_used_when_asked(tmp_path):
    Session.create(tmp_path, "run")
    assert Session.create(tmp_path, "run", new_session=False).name == "run"


def test_missing_sessions_are_named_with_those_that_exist(tmp_path):
    Session.create(tmp_path, "training")
    with pytest.raises(SessionError, match='no session "trainin".*Did you mean "training"'):
        Session.existing(tmp_path, "trainin")


@pytest.mark.parametrize("name", ["", "a/b", ".."])
def test_names_that_are_no_folders_are_refused(tmp_path, name):
    with pytest.raises(SessionError):
        Session.create(tmp_path, name)


def test_a_file_in_the_way_is_an_error(tmp_path):
    (tmp_path / "sessions").write_text("")
    with pytest.raises(SessionError, match="Cannot make"):
        Session.create(tmp_path / "sessions", "run")


def test_record_adds_to_info_and_keeps_the_notes(tmp_path):
    session = Session.create(tmp_path, "run")
    session.record("training", {"epoch_nb": 1}, 5)
    info = session.path / "info.txt"
    info.write_text(info.read_text().replace("(Write here", "MINE (Write here"))
    session.record("prediction", {"step_nb": 2}, 6)
    text = info.read_text()
    assert "MINE" in text and "seed: 5" in text and "step_nb = 2" in text and "numpy" in text
    assert "[training]" in (session.path / "config.toml").read_text()
    assert "[prediction]" in (session.path / "config.toml").read_text()
