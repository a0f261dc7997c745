"""Code that relies on private parts of torch, TorchRL, tensordict or Rerun, or works around their bugs.

There is one function, class or constant for each, with a test in `tests/test_compat.py` that shows what an
upgrade has broken. What is missing is an ImportError that names the part and the versions that fit
(`cprl.system.libraries`). The rest of cprl uses public interfaces. Two exceptions are elsewhere:

- code that relies on Numba is in `cprl.commons.compiled`, because the game works without torch;
- methods with an underscore that a library expects its subclasses to define (`EnvBase._reset`, `_step` and
  `_set_seed`, `Storage._empty`, `Sampler._empty`, `Logger._create_experiment`) are its interface for that.

Nothing here is for users, and there is no `__all__`.

Modules:
    tensordicts   entries of TensorDicts, read and written past its checks
    torchrl       environments, specs, losses, targets and estimators of TorchRL
    compiling     torch.compile: what it is asked for, its cache and its guards
    recordings    recordings of Rerun
"""

from cprl.system.compat.compiling import COMPILE_OPTIONS as COMPILE_OPTIONS
from cprl.system.compat.compiling import NO_GUARDS as NO_GUARDS
from cprl.system.compat.compiling import compiled_code as compiled_code
from cprl.system.compat.compiling import every_guard as every_guard
from cprl.system.compat.compiling import fits as fits
from cprl.system.compat.compiling import quiet_about_fallbacks as quiet_about_fallbacks
from cprl.system.compat.compiling import remember_vector_instructions as remember_vector_instructions
from cprl.system.compat.compiling import sound_local_buffers as sound_local_buffers
from cprl.system.compat.compiling import with_own_code as with_own_code
from cprl.system.compat.compiling import without_lookup as without_lookup
from cprl.system.compat.recordings import StoredLayout as StoredLayout
from cprl.system.compat.recordings import end_recordings as end_recordings
from cprl.system.compat.recordings import keep_native as keep_native
from cprl.system.compat.tensordicts import Views as Views
from cprl.system.compat.tensordicts import entry as entry
from cprl.system.compat.tensordicts import put as put
from cprl.system.compat.tensordicts import put_all as put_all
from cprl.system.compat.tensordicts import unchecked_tensordict as unchecked_tensordict
from cprl.system.compat.torchrl import LaneCategorical as LaneCategorical
from cprl.system.compat.torchrl import LeanStepEnv as LeanStepEnv
from cprl.system.compat.torchrl import ReshapedLoss as ReshapedLoss
from cprl.system.compat.torchrl import entropy_by_formula as entropy_by_formula
from cprl.system.compat.torchrl import flag_spec as flag_spec
from cprl.system.compat.torchrl import forget_cached_weights as forget_cached_weights
from cprl.system.compat.torchrl import promise_targets as promise_targets
from cprl.system.compat.torchrl import refuse_updaters as refuse_updaters
from cprl.system.compat.torchrl import updated_weights as updated_weights
