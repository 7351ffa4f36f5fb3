"""A live camera, or a folder that fills, taken through its shooting list; and targets followed on the stream.

A camera behind one small protocol and a shooting list enter; frames, a log that a killed run goes on from, and the manifest that
`pixmetry assess` reads leave.
"""
