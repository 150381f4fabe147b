"""Numba's compiler for kernels that only other kernels call: code is made once, by the caller.

Numba optimises each kernel with all that it calls, and makes machine code of it, before a caller
takes it in and does so again: the innermost kernels are optimised once for each level of calls above
them, and for a sensor that is more than half of the time.  Kernels compiled here are kept as they come
from numba's types; the kernel that Python calls is optimised whole.
"""

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import LoweringPass, register_pass
from numba.core.typed_passes import NativeLowering, NopythonTypeInference


class _Ingredient(JITCodeLibrary):
    """Code of a kernel that its callers take in, without machine code of its own."""

    def _optimize_final_module(self):
        """Leave it to the caller."""

    def _finalize_final_module(self):
        self._finalize_dynamic_globals()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _BeginIngredient(LoweringPass):
    """Have numba write its code to an :class:`_Ingredient`."""

    _name = "begin_ingredient"

    def __init__(self):
        super().__init__()

    def run_pass(self, state):
        state.library = _Ingredient(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        return False


@register_pass(mutates_CFG=True, analysis_only=False)
class _OfferIngredient(LoweringPass):
    """Let kernels find what was compiled, and nobody else."""

    _name = "offer_ingredient"

    def __init__(self):
        super().__init__()

    def run_pass(self, state):
        # Numba wants a function of Python's own that is different for each kernel.  This one raises an
        # error whatever it is called with.
        refuse = (state.func_id.func_qualname,).index
        state.cr = state.cr._replace(cfunc=refuse)
        state.targetctx.insert_user_function(refuse, state.cr.fndesc, [state.library])
        return False


class InnerCompiler(CompilerBase):
    """Numba's own passes, with code that is optimised by the callers."""

    def define_pipelines(self):
        """Return the passes."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(_BeginIngredient, NopythonTypeInference)
        passes.add_pass_after(_OfferIngredient, NativeLowering)
        passes.finalize()
        return [passes]
