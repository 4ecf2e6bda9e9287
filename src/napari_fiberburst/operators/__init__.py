"""Linear operators on images and samples, each with its adjoint.

An operator A is called to apply it, ``A(x)``, and ``A.adjoint(y)`` applies A', so that <A x, y> = <x, A' y> with the
inner product over all elements. ``tests/operators/test_adjoint.py`` holds every operator to that. Faster kernels
take the place of operators, never of the code that uses them.
"""
