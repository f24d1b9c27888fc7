"""What a model may lack: named effects, unnamed nonlinearities, bases, disturbances, packet loss."""
