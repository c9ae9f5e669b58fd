"""Learner of the benchmark: TQC of sb3-contrib with its default settings.

cd examples
trl-suite benchmark run PD_Biped2D_Gaps_Terrain-v0 --learner tqc_learner:TQC
"""

import sb3_contrib
from stable_baselines_learners import PPO


class TQC(PPO):
    """Truncated quantile critics."""

    kind = sb3_contrib.TQC
