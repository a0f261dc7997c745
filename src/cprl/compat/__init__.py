"""Code that relies on private parts of torch, TorchRL, tensordict or Rerun, or works around their bugs.

There is one function, class or constant for each, with a test in `tests/test_compat.py` that shows what an
upgrade has broken. The rest of cprl uses public interfaces. Two exceptions are elsewhere:

- code that relies on Numba is in `cprl.commons.compiled`, because the game works without torch;
- methods with an underscore that a library expects its subclasses to define (`EnvBase._reset`, `_step` and
  `_set_seed`, `Storage._empty`, `Sampler._empty`, `Logger._create_experiment`) are its interface for that.

Modules:
    tensordicts   entries of TensorDicts, read and written past its checks
    environments  environments and specs of TorchRL
    losses        losses of TorchRL, their targets and estimators
    compiling     torch.compile: what it is asked for, its cache and its guards
    recordings    recordings of Rerun
"""

from cprl.compat.compiling import (
    COMPILE_OPTIONS,
    NO_GUARDS,
    compiled_code,
    every_guard,
    fits,
    remember_vector_instructions,
    sound_local_buffers,
    with_own_code,
    without_lookup,
)
from cprl.compat.environments import LeanStepEnv, flag_spec
from cprl.compat.losses import (
    LaneCategorical,
    ReshapedLoss,
    bootstrap_from_target,
    forget_cached_weights,
    hard_update,
    promise_targets,
    refuse_updaters,
    updated_weights,
)
from cprl.compat.recordings import end_recordings, keep_native, rows_made, send_chunk, send_made
from cprl.compat.tensordicts import entry, put, put_all, unchecked_tensordict

__all__ = [
    "COMPILE_OPTIONS",
    "NO_GUARDS",
    "LaneCategorical",
    "LeanStepEnv",
    "ReshapedLoss",
    "bootstrap_from_target",
    "compiled_code",
    "end_recordings",
    "entry",
    "every_guard",
    "fits",
    "flag_spec",
    "forget_cached_weights",
    "hard_update",
    "keep_native",
    "promise_targets",
    "put",
    "put_all",
    "refuse_updaters",
    "remember_vector_instructions",
    "rows_made",
    "send_chunk",
    "send_made",
    "sound_local_buffers",
    "unchecked_tensordict",
    "updated_weights",
    "with_own_code",
    "without_lookup",
]
