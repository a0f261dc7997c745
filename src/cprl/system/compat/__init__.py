"""Code that relies on private parts of torch, TorchRL, tensordict or Rerun, or works around their bugs.

There is one function, class or constant for each, with a test in `tests/system/test_compat.py` that shows
what an upgrade has broken. What is missing is an ImportError that names the part and the versions that fit
(`cprl.system.libraries`). The rest of cprl uses public interfaces. Two exceptions are elsewhere:

- code that relies on Numba is in `cprl.system.jit`;
- methods with an underscore that a library expects its subclasses to define (`EnvBase._reset`, `_step` and
  `_set_seed`, `Storage._empty`, `Sampler._empty`, `Logger._create_experiment`) are its interface for that.

Nothing here is for users, and there is no `__all__`.

Modules:
    tensordicts   entries of TensorDicts, read and written past its checks
    torchrl       environments, specs, losses, targets and estimators of TorchRL
    torch_compile torch.compile: what it is asked for, its cache and its guards
    recordings    recordings of Rerun
"""
