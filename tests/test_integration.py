"""What an Integration may be, and how arguments change a preset."""

from __future__ import annotations

import pytest

from diffsim.sim.integration import INTEGRATORS, Integration


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_every_integrator_has_a_default(integrator: str) -> None:
    Integration(integrator).check()


@pytest.mark.parametrize(
    "integration, message",
    [
        (Integration("rk4"), "'rk4'.*semi_implicit, implicit, extrapolated"),
        (Integration(substeps=0), "substeps is 0.*at least 1"),
        (Integration(substeps=2.0), "substeps is 2.0.*integer"),  # type: ignore[arg-type]
        (Integration("extrapolated", 7), "substeps is 7, must be even"),
        (Integration("implicit", theta=1.5), r"theta is 1.5.*\[0, 1\]"),
        (Integration("implicit", theta=float("nan")), "theta is nan"),
        (Integration("semi_implicit", theta=0.5), "theta is 0.5, but only the implicit"),
        (Integration("extrapolated", theta=0.5), "theta is 0.5, but only the implicit"),
    ],
)
def test_what_cannot_be_integrated_is_said(integration: Integration, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        integration.check()


def test_what_is_given_replaces_the_presets() -> None:
    preset = Integration("implicit", 8, 0.5)
    assert preset.replaced(None, substeps=None, theta=None) == preset
    assert preset.replaced("implicit") == preset
    assert preset.replaced(substeps=4, theta=0.0) == Integration("implicit", 4, 0.0)
    assert preset.replaced("semi_implicit") == Integration("semi_implicit", 8)  # theta is the implicit's own
    assert preset.replaced("semi_implicit", theta=0.5).theta == 0.5  # asked for: an error, not dropped
