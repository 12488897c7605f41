"""Settings of the exploration bonus for values that few episodes reach."""

from dataclasses import dataclass

from hmasd_jax.validation import check_range, check_types


@dataclass(frozen=True)
class FrontierConfig:
    """Settings of the bonus."""

    coef: float = 0.0
    """Weight of the bonus in the reward, for a bonus in standard deviations of all bonuses so far,
    at least 1, times the largest mean return of an episode so far, at least 1. With 0 there is
    none."""
    num_bins: int = 20
    """Bins per feature, between the smallest and the largest value so far."""
    largest_worth: float = 100.0
    """Most that one value is worth. It keeps accidents from outweighing everything else."""
    window: int = 20
    """Rollouts over which the share of episodes is averaged, with exponential weights."""
    forgetting: float = 0.01
    """Part of the largest share that is forgotten per rollout."""
    period: int = 0
    """Steps after which an episode under way counts as another one. With 0 each counts once."""
    patience: int = 0
    """Rollouts over which the best return becomes usual, so that the bonus fades. With 0 it does
    not, and neither does it before the best return is above 1."""
    pair_coef: float = 0.0
    """Weight of pairs of features beside single ones. With 0 they are not counted, and neither are
    they before the best return is above 1."""
    fade_entropy: bool = False
    """If True, weight the entropy of actions by the share of recent episodes that are unsolved."""

    def __post_init__(self) -> None:
        check_types(self)
        check_range(self, "coef", "largest_worth", "pair_coef", low=0)
        check_range(self, "num_bins", low=2)
        check_range(self, "window", low=1)
        check_range(self, "forgetting", low=0, high=1)
        check_range(self, "period", "patience", low=0)
        if self.pair_coef and self.coef == 0:
            raise ValueError(
                "pair_coef needs coef above 0: pairs are paid as a part of the frontier"
            )
        if self.fade_entropy and self.coef == 0:
            raise ValueError(
                "fade_entropy needs coef above 0: without the frontier no episodes are counted"
            )
