"""Raw blocks of coil samples to a temperature: convert, features, laws, the Kalman filter, limits, supervision.

`pipeline` runs the stages in C, the blocks of one message at a time; C stands beside its Python under the same name.
"""
