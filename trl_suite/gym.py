"""Gymnasium's interface; importing it registers the ids. See `trl_suite.adapters.gym`."""

from trl_suite.adapters.gym import SuiteEnv, SuiteVectorEnv

__all__ = ['SuiteEnv', 'SuiteVectorEnv']
