"""The front door in Python (docs/python.md): what `import s2r_runtime as s2r` gives, and what the command line calls.

    models, recordings        what a model, a profile, a controller and a recording may be given as
    gaps, tracing, verification, certification, logs, live     one module a verb: the work, the result, the public function
    trials                    runs in logs, rolled out again and paired: for the command line
    progress, results, frames, spelling                        progress and notes; results as text, HTML and plots; tables; messages

Public functions take the options of the command line as keywords, raise the errors of `s2r_runtime.errors`, and return frozen values.
"""
