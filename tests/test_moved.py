"""Names at their former places still work, and warn."""

import importlib
import warnings

import pytest

import roadgym
from roadgym import record
from roadgym.cars.one_mass import free_decay
from roadgym.task import signals

SIGNALS = set(signals(roadgym.QuarterCar()))


@pytest.mark.parametrize(
    ("module", "name", "right"),
    [
        ("roadgym.task", "SIGNALS", lambda found: set(found) == SIGNALS and len(found) == 9),
        ("roadgym.kernel", "SIGNALS", lambda found: set(found) == SIGNALS and len(found) == 9),
        ("roadgym.kernel", "interval_weights", lambda found: found(2).tolist() == pytest.approx([1 / 6, 4 / 6, 1 / 6])),
        ("roadgym.kernel", "DISABLED", lambda found: found == record.DISABLED),
        ("roadgym.kernel", "free_decay", lambda found: found is free_decay),
        ("roadgym.kernel", "inlined", callable),
        *(
            (f"roadgym.{name}", "MEAN_SQUARES", lambda found: found == roadgym.MEAN_SQUARES)
            for name in ("env", "reward", "task", "vector")
        ),
        ("agents.vec_env", "action_space", lambda found: found(None).shape == (1,)),
    ],
)
def test_names_at_their_former_places_work_and_warn_once(module, name, right):
    here = importlib.import_module(module)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert right(getattr(here, name))
    (warning,) = caught
    assert warning.category is DeprecationWarning
    assert str(warning.message).startswith(f"{module}.{name} is now ")
    assert warning.filename == __file__  # where it is used
    with pytest.raises(AttributeError, match=f"module '{module}' has no attribute 'NAME'"):
        here.NAME  # noqa: B018
