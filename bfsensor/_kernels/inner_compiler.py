"""Compilers by which code of kernels is optimised once, in the kernel that Python calls.

Numba optimises each kernel with all that it calls, and makes machine code of it, before a caller takes
it in and does so again: the innermost kernels are optimised once for each level of calls above them,
and for a sensor that is more than half of the time.  With :class:`InnerCompiler` a kernel is kept as it
comes from numba's types; with :class:`EntryCompiler` one is optimised with all that it calls.
"""

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import LoweringPass, register_pass
from numba.core.typed_passes import NativeLowering, NopythonTypeInference

LEVEL = 2
"""Level of optimisation of LLVM.

Measured (tests/benchmarks/bench_sensor.py): at numba's own, 3, a sensor's kernels compile for 1.2 CPU
seconds more and are no faster; at 1 for 0.3 less, with stars and flats within 5 %."""

UNUSED = {
    "WithLifting", "InlineClosureLikes", "RewriteSemanticConstants", "DeadBranchPrune",
    "RewriteDynamicRaises", "MakeFunctionToJitFunction", "FindLiterallyCalls", "LiteralUnroll",
    "LiteralPropagationSubPipelinePass", "InlineInlinables", "InlineOverloads",
    "NopythonRewrites", "NoPythonSupportedFeatureValidation", "AnnotateTypes",
}  # fmt: skip
"""Passes of numba for what inner kernels have not, by name: closures, ``with``, ``raise``, array
expressions, notes for reports.  Numba looks the whole kernel through after each of them."""


class _Ingredient(JITCodeLibrary):
    """Code of a kernel that its callers take in, without machine code of its own."""

    def _optimize_functions(self, ll_module):
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self):
        """Leave it to the caller."""

    def _finalize_final_module(self):
        self._finalize_dynamic_globals()
        self._finalized = True


class _Whole(JITCodeLibrary):
    """Code of a kernel and of all that it calls, optimised in one go."""

    def _optimize_functions(self, ll_module):
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self):
        passes, builder = self._codegen._module_pass_manager(opt=LEVEL)
        passes.run(self._final_module, builder)


class _LibraryPass(LoweringPass):
    """A step between numba's own that sees to the library of a kernel's code."""

    def __init__(self):
        super().__init__()

    def run_pass(self, state):
        """Carry it out; returns whether numba's representation of the kernel has changed."""
        self.see_to(state)
        return False


@register_pass(mutates_CFG=False, analysis_only=False)
class _BeginIngredient(_LibraryPass):
    _name = "begin_ingredient"

    def see_to(self, state):
        state.library = _Ingredient(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True


@register_pass(mutates_CFG=False, analysis_only=False)
class _OfferIngredient(_LibraryPass):
    _name = "offer_ingredient"

    def see_to(self, state):
        # Other kernels find the code by a function of Python's own, which has to be another for each
        # kernel.  This one raises an error whatever it is called with.
        refuse = (state.func_id.func_qualname,).index
        state.cr = state.cr._replace(cfunc=refuse)
        state.targetctx.insert_user_function(refuse, state.cr.fndesc, [state.library])


@register_pass(mutates_CFG=False, analysis_only=False)
class _BeginWhole(_LibraryPass):
    _name = "begin_whole"

    def see_to(self, state):
        state.library = _Whole(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()


class InnerCompiler(CompilerBase):
    """Compiler of kernels that only other kernels call."""

    def define_pipelines(self):
        """Return numba's passes less those that are not needed, with the code left as it is."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [p for p in passes.passes if p[0].__name__ not in UNUSED]
        passes.add_pass_after(_BeginIngredient, NopythonTypeInference)
        passes.add_pass_after(_OfferIngredient, NativeLowering)
        passes.finalize()
        return [passes]


class EntryCompiler(CompilerBase):
    """Compiler of kernels that Python calls, not for parallel ones."""

    def define_pipelines(self):
        """Return numba's passes, with the code of kernels within optimised here."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(_BeginWhole, NopythonTypeInference)
        passes.finalize()
        return [passes]
