"""Physics beyond rigid bodies with viscous and Coulomb friction, as dynamic simulation; one module per kind.

Equations are written here for the emulated truth alone. `ident` supposes effects in forms of its own and never
imports this package.
"""
